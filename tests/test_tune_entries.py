"""A tuning's best configuration as an entry of a YAML file: what the sampler returns, and what rl_zoo3 takes."""

import argparse

import numpy as np
import optuna
import pytest
import yaml
from optuna.samplers import RandomSampler
from rl_zoo3 import ALGOS
from rl_zoo3.exp_manager import ExperimentManager
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from torch import nn
from tunings import samples

from benchmark import tune
from benchmark.sweeps.entries import base_entry, sampled_entry, write_entry


@pytest.mark.parametrize("algo", ["cgp", "td3", "ddpg", "sac", "tqc", "ppo", "a2c", "trpo"])
def test_an_entry_says_what_the_sampler_returns(algo):
    base = base_entry(algo, "Pendulum-v1") if algo != "trpo" else {"policy": "MlpPolicy", "n_timesteps": 100}
    for sampled, params in samples(algo):
        entry = sampled_entry(algo, base, params)
        assert yaml.safe_load(yaml.safe_dump(entry)) == entry
        noise = sampled.pop("action_noise", None)
        kinds = {"normal": NormalActionNoise, "ornstein-uhlenbeck": OrnsteinUhlenbeckActionNoise}
        assert type(noise) is kinds.get(entry.get("noise_type"), type(None))
        if noise is not None:
            np.testing.assert_array_equal(noise._sigma, entry["noise_std"])
        assert eval(entry["policy_kwargs"], {"nn": nn}) == sampled.pop("policy_kwargs")
        for name, value in sampled.items():
            assert entry[name] == value, name


@pytest.mark.parametrize("algo", ["cgp", "td3", "sac", "ppo"])
def test_rl_zoo3_makes_a_model_of_an_entry(tmp_path, algo):
    base = base_entry(algo, "Pendulum-v1")
    for _, params in list(samples(algo))[:3]:
        entry = sampled_entry(algo, base, params) | ({} if algo == "ppo" else {"buffer_size": 100})
        write_entry(tmp_path / "mine.yml", "Pendulum-v1", entry, "a sample")
        args = argparse.Namespace()
        conf_file = str(tmp_path / "mine.yml")
        manager = ExperimentManager(args, algo, "Pendulum-v1", str(tmp_path), config=conf_file, verbose=0, device="cpu")
        model, _ = manager.setup_experiment()
        assert isinstance(model, ALGOS[algo])
        assert model.gamma == entry["gamma"]
        assert (getattr(model, "action_noise", None) is None) == ("noise_type" not in entry)


@pytest.mark.parametrize("algo", ["cgp", "sac", "td3"])
def test_suggestions_for_hindsight_come_beside_what_the_entry_has(algo):
    base = {"policy": "MultiInputPolicy", "replay_buffer_class": "HerReplayBuffer"}
    for kwargs in ("dict(copy_info_dict=True, n_sampled_goal=9)", {"copy_info_dict": True}):
        for sampled, params in samples(algo, her={"copy_info_dict": True}):
            entry = sampled_entry(algo, base | {"replay_buffer_kwargs": kwargs}, params)
            assert eval(entry["replay_buffer_kwargs"]) == sampled["replay_buffer_kwargs"]
            assert "n_sampled_goal" not in entry


def test_no_noise_takes_the_bases_noise_away():
    base = {"policy": "MlpPolicy", "noise_type": "normal", "noise_std": 0.1}
    params = next(params for _, params in samples("td3") if params["noise_type"] is None)
    assert not sampled_entry("td3", base, params).keys() & {"noise_type", "noise_std"}


@pytest.mark.parametrize(
    ("options", "random", "is_said"),
    [
        (["--steps", "800"], 80, True),
        (["--steps", "800", "--set", "learning_starts=500"], 500, False),
        # As long as the entry says, or longer
        ([], 10_000, False),
        (["--steps", "30000"], 10_000, False),
    ],
)
@pytest.mark.parametrize("algo", ["cgp", "td3"])
def test_at_most_a_tenth_of_a_shortened_run_is_random(algo, options, random, is_said, capsys):
    tuning = tune.tuning_of(tune.parse(["--algo", algo, "--env", "Pendulum-v1", *options]))
    study = optuna.create_study(sampler=RandomSampler(seed=0))
    tuning.sample(study.ask())
    entry = tuning.entry(study.trials[0])
    assert entry["n_timesteps"] == (int(options[1]) if options else 20_000)
    assert entry["learning_starts"] == random
    assert ("Of the 800 steps, 80 are random" in capsys.readouterr().err) == is_said
