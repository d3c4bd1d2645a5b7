"""A tuning's best configuration as an entry of a YAML file: what the sampler returns, and what rl_zoo3 takes."""

import argparse
import re

import gymnasium as gym
import numpy as np
import optuna
import pytest
import yaml
from optuna.samplers import RandomSampler
from rl_zoo3 import ALGOS
from rl_zoo3.exp_manager import ExperimentManager
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv
from torch import nn
from tunings import samples

from benchmark import tune
from benchmark.common.arguments import hyperparameter
from benchmark.sweeps.checks import check_tuning
from benchmark.sweeps.entries import base_entry, sampled_entry, write_entry
from sb3_cgp.core.arguments import check_arguments


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


@pytest.fixture(scope="module")
def pendulum():
    return DummyVecEnv([lambda: gym.make("Pendulum-v1")])


def drawn(algo, settings, n_draws=200):
    """The entries of trials, with what their parameters and the attributes for people are."""
    options = ["--algo", algo, "--env", "Pendulum-v1", *(["--set", *settings] if settings else [])]
    tuning = tune.tuning_of(tune.parse(options))
    study = optuna.create_study(sampler=RandomSampler(seed=0))
    for _ in range(n_draws):
        tuning.sample(study.ask())
    return [(tuning.entry(trial), trial) for trial in study.trials]


def make(algo, entry, env, **further):
    """A model of an entry, as rl_zoo3 makes it of a YAML file, but small."""
    entry = {name: value for name, value in entry.items() if name not in ("n_timesteps", "normalize", "callback")}
    noise_type = entry.pop("noise_type", None)
    if noise_type is not None:
        assert noise_type in ("normal", "ornstein-uhlenbeck")
        entry["action_noise"] = NormalActionNoise(np.zeros(1), entry.pop("noise_std") * np.ones(1))
    small = dict(policy_kwargs=dict(net_arch=[4]), buffer_size=10, device="cpu")
    return ALGOS[algo](env=env, **entry | small, **further)


@pytest.mark.parametrize(
    "settings",
    [
        "", "cem_start=actor cem_iterations=1 cem_samples=16", "cem_samples=1 cem_start=prior", "cem_elites=20",
        "cem_elites=200", "cem_samples=40 cem_elites=20", "policy_loss=null", "policy_loss=qgp", "policy_training=offline",
        "policy_training=offline cem_start=actor", "inference=averaged_actor", "inference=cem", "inference=null",
        "noise_type=null", "noise_type=normal", "noise_std=0.1", "train_freq=1",
    ],
)  # fmt: skip
def test_every_draw_is_valid_together_with_what_is_fixed(settings, pendulum):
    fixed = dict(map(hyperparameter, settings.split()))
    for entry, trial in drawn("cgp", settings.split()):
        # The rules without the networks, which take long; whole models are made of the first draws
        model = make("cgp", entry, pendulum, _init_setup_model=trial.number < 3)
        check_arguments(model, ("cgp", "qgp"))
        assert model.policy_loss is not None or model.cem_start == "prior"
        assert {name: value for name, value in fixed.items() if "noise" not in name}.items() <= entry.items()
        # The dashboard shows what is trained
        shown = trial.user_attrs
        assert (shown["cem_samples"], shown["cem_elites"]) == (model.cem_samples, model.cem_elites)
        assert (shown["policy_loss"], shown["policy_training"]) == (model.policy_loss, model.policy_training)


@pytest.mark.parametrize("settings", ["noise_type=normal", "noise_std=0.1", "noise_type=null"])
def test_fixed_noise_is_valid_with_each_sampled_noise(settings, pendulum):
    for entry, trial in drawn("td3", [settings], 30):
        is_noisy = trial.params["noise_type"] is not None if settings == "noise_std=0.1" else settings == "noise_type=normal"
        assert (make("td3", entry, pendulum).action_noise is not None) == is_noisy


def test_elites_are_a_fraction_of_fixed_samples_and_variants_are_the_nearest_that_fit():
    for entry, trial in drawn("cgp", ["cem_samples=32"], 50):
        assert entry["cem_elites"] == max(round(32 * trial.params["cem_elite_fraction"]), 1)
    nearest = {"cgp-online": "cgp", "cgp-offline": "cgp", "qgp-online": "qgp", "qgp-offline": "qgp", "cem": "cgp"}
    seen = {(trial.params["variant"], entry["policy_loss"]) for entry, trial in drawn("cgp", ["policy_training=offline"])}
    assert seen == set(nearest.items())
    assert {entry["policy_loss"] for entry, _ in drawn("cgp", ["cem_start=actor"])} == {"cgp", "qgp"}


def test_what_is_fixed_leaves_the_distributions_of_a_study():
    """Optuna takes no other choices in a study that has begun."""
    for settings in (["cem_start=actor", "cem_samples=16"], ["policy_loss=null"], ["cem_elites=20"]):
        ((_, trial),), ((_, free),) = drawn("cgp", settings, 1), drawn("cgp", [], 1)
        assert trial.distributions == free.distributions


def test_a_share_of_configurations_that_cannot_be_trained_is_told(capsys):
    options = ["--algo", "cgp", "--env", "Pendulum-v1", "--set", "cem_actor_std=0", "cem_actor_fraction=1"]
    check_tuning(tune.tuning_of(tune.parse(options)))
    assert re.search(r"of 10 sampled configurations, \d cannot be trained \(.*`cem_actor_std`.*--set", capsys.readouterr().err)
    check_tuning(tune.tuning_of(tune.parse(options[:4])))
    assert "Warning" not in capsys.readouterr().err
