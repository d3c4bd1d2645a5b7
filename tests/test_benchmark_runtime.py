"""``python -m benchmark.runtime``: its contenders, and what it writes. Times themselves are not tested."""

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import torch as th
from measuring_commands import CPU, run_command
from stable_baselines3.common.env_util import make_vec_env
from tables import unpadded
from torch import nn

from benchmark import runtime
from benchmark.speed import contenders, run_times
from sb3_cgp import CGP
from sb3_cgp.core.policies import CGPPolicy as PlainPolicy


def test_plain_policy_selects_what_the_fast_one_selects():
    env = make_vec_env("Pendulum-v1", seed=0)
    fast, plain = (CGP(policy, env, buffer_size=10, seed=0) for policy in ("MlpPolicy", PlainPolicy))
    plain.set_parameters(fast.get_parameters())
    fast.policy.cem_dtype = "float32"
    observations = th.randn(20, 3)
    selections = []
    for model in (fast, plain):
        th.manual_seed(7)
        selections.append(model.policy.select_actions(observations, model.critic))
    th.testing.assert_close(selections[0].actions, selections[1].actions, rtol=1e-4, atol=1e-4)
    th.testing.assert_close(selections[0].std, selections[1].std, rtol=1e-4, atol=1e-4)


def test_plain_policy_repeats_every_observation():
    model = CGP(PlainPolicy, make_vec_env("Pendulum-v1"), buffer_size=10, cem_samples=8, cem_iterations=3)
    # By PyTorch's modules alone
    assert all(type(network) is nn.Sequential for network in (model.actor.mu, *model.critic.q_networks))
    rows = []
    first = model.critic.q_networks[0][0]
    first.register_forward_hook(lambda layer, inputs, output: rows.append(inputs[0].shape))
    model.policy.select_actions(th.randn(5, 3), model.critic)
    assert rows == [(5 * 8, 3 + 1)] * 3


@pytest.fixture(scope="module")
def runtime_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run-time table of a few methods, without SBX, on episodes of a few steps."""
    th.set_num_threads(1)
    folder = tmp_path_factory.mktemp("runtime")
    options = "--env Pendulum-v1 --episode-steps 6 --episodes 3 --inference-episodes 4 --seed 5"
    with pytest.MonkeyPatch.context() as patch:
        # What Python puts there for a module that shall not be found
        patch.setitem(sys.modules, "sbx", None)
        methods = ["Random", "SAC", "TD3", "CEM-2", "CGP-2", "CGP-2-plain", "SBX-TD3"]
        run_command("runtime", folder, *options.split(), "--methods", *methods)
    return folder


def test_runtime_ratios_follow_from_the_seconds(runtime_folder):
    methods = json.loads((runtime_folder / "runtime.json").read_text())["methods"]
    for phase, rounds in (("train", 3), ("inference", 4)):
        reference = methods["TD3"][phase]["seconds"]["all"]
        assert methods["TD3"][phase]["ratio"] == 1.0
        for name in ("SAC", "CEM-2", "CGP-2", "CGP-2-plain"):
            seconds = methods[name][phase]["seconds"]
            assert len(seconds["all"]) == rounds
            assert min(seconds["all"]) > 0.0
            assert seconds["median"] == pytest.approx(np.median(seconds["all"]))
            ratios = sorted(mine / td3 for mine, td3 in zip(seconds["all"], reference, strict=True))
            assert methods[name][phase]["ratio"] == pytest.approx((ratios[(rounds - 1) // 2] + ratios[rounds // 2]) / 2)


def test_timed_episodes_make_one_gradient_step_per_environment_step(runtime_folder):
    methods = json.loads((runtime_folder / "runtime.json").read_text())["methods"]
    for name in ("SAC", "TD3", "CEM-2", "CGP-2", "CGP-2-plain"):
        assert methods[name]["timed_gradient_steps"] == 3 * 6, name


def test_runtime_table_says_what_was_measured(runtime_folder):
    record = json.loads((runtime_folder / "runtime.json").read_text())
    text = (runtime_folder / "runtime.md").read_text()
    lines = [[cell.strip() for cell in line.split("|")] for line in text.splitlines() if line.startswith("|")]
    rows = {name: cells for _, name, *cells, _ in lines}
    assert rows["Random"][:3] == ["-", "-", "-"]
    assert rows["Random"][5] == "0.20"
    assert rows["TD3"][1:3] == ["1.00", "1.00"]
    assert rows["CGP-2"][1:3] == [f"{record['methods']['CGP-2']['train']['ratio']:.2f}", "1.95"]
    assert rows["CEM-2"][4:] == [f"{record['methods']['CEM-2']['inference']['ratio']:.2f}", "2.68"]
    assert rows["SBX-TD3"][0] == record["methods"]["SBX-TD3"]["missing"]
    assert re.match("not measured: .*sbx", rows["SBX-TD3"][0])
    assert "CGP-4" not in rows
    assert (record["env"], record["episode_steps"], record["seed"]) == ("Pendulum-v1", 6, 5)
    # Of PyPI's builds for CUDA, PyTorch alone names the local version
    assert record["versions"]["torch"] in (th.__version__, th.__version__.partition("+")[0])
    assert record["machine"]["torch_threads"] == 1
    assert record["command"].startswith("python -m benchmark.runtime --env Pendulum-v1 ")
    assert record["command"] in text


def test_without_td3_there_are_no_ratios(tmp_path):
    options = "--env Pendulum-v1 --episode-steps 2 --episodes 1 --inference-episodes 1 --methods DDPG"
    record = run_command("runtime", tmp_path, *options.split())
    assert record["methods"]["DDPG"]["train"]["ratio"] is None
    assert "| - | 1.01 |" in unpadded((tmp_path / "runtime.md").read_text())


def test_every_contender_has_the_same_batch_and_network():
    env = make_vec_env("Pendulum-v1")
    for name, contender in contenders.CONTENDERS.items():
        if contender.package in (None, "sbx"):
            continue
        model = contenders.make_agent(name, env, learning_starts=1, seed=0, device=CPU)
        widths = [layer.out_features for layer in model.actor.modules() if isinstance(layer, th.nn.Linear)]
        assert widths[:2] == [256, 256], name
        networks = getattr(model.critic, "quantile_critics", None) or model.critic.q_networks
        assert len(networks) == (1 if name == "DDPG" else 2), name
        for network in networks:
            widths = [layer.out_features for layer in network.modules() if isinstance(layer, th.nn.Linear)]
            assert widths[:-1] == [256, 256], name
        assert (model.batch_size, model.gradient_steps, model.train_freq.frequency) == (128, 1, 1), name
        if contender.algorithm == "CGP":
            sizes = (1, 16, "actor") if name.startswith("CGP-Light") else (int(name[4]), 64, "prior")
            assert (model.cem_iterations, model.cem_samples, model.cem_start) == sizes, name
            assert model.policy_delay == (2 if name == "CGP-Light-delayed" else 1), name
            assert model.policy.inference == ("cem" if name.startswith("CEM") else "actor"), name


def test_data_type_goes_to_the_methods_that_score_by_the_fast_way(tmp_path, monkeypatch):
    given = {}
    monkeypatch.setattr(run_times, "make_agent", lambda name, *args, **kwargs: given.update({name: kwargs}))
    methods = ["TD3", "CEM-4", "CGP-2", "CGP-2-plain"]
    options = f"--env Pendulum-v1 --cem-dtype float32 --folder {tmp_path}"
    args = runtime.parse([*options.split(), "--methods", *methods])
    run_times.make_agents(args)
    float32 = {"cem_dtype": "float32"}
    assert given == {"TD3": {}, "CEM-4": float32, "CGP-2": float32, "CGP-2-plain": {}}


def test_inference_acts_deterministically_for_as_many_steps_as_asked():
    asked = []

    class Agent(contenders.RandomAgent):
        def predict(self, observation, deterministic=False):
            asked.append((observation.copy(), deterministic))
            return super().predict(observation, deterministic)

    episode = run_times.inference_episode(Agent(make_vec_env("Pendulum-v1")), "Pendulum-v1", seed=0, steps=4)
    episode()
    episode()
    assert [deterministic for _, deterministic in asked] == [True] * 8
    # It goes on where it was, rather than from the same start
    assert len({observation.tobytes() for observation, _ in asked}) == 8
