"""Which runs of a sweep may share a process."""

import pytest
import yaml

from benchmark.sweeps.experiments import load_sweep
from benchmark.sweeps.sharing import common_settings


@pytest.fixture
def runs_of(tmp_path):
    """Make the runs of a sweep of two methods, A and B."""

    def make(a, b, **fields):
        methods = {name: {"algo": "cgp", "hyperparams": {"policy": "MlpPolicy"}} | {"tuned": False} for name in ("A", "B")}
        for name, changes in (("A", a), ("B", b)):
            changes = dict(changes)
            methods[name]["algo"] = changes.pop("algo", "cgp")
            methods[name]["tuned"] = changes.pop("tuned", False)
            methods[name]["hyperparams"] |= changes
        content = dict(title="A sweep", methods=methods, tasks=["Pendulum-v1"], steps=1_000, seeds=1, evaluation_interval=50)
        path = tmp_path / "mine.yml"
        path.write_text(yaml.safe_dump(content | fields))
        return load_sweep(str(path)).runs()

    return make


NOISE = dict(noise_type="normal", noise_std=0.1)


@pytest.mark.parametrize(
    ("a", "b", "may_share"),
    [
        ({}, {}, True),
        (dict(learning_rate=0.01, gamma=0.9, tau=0.1), dict(learning_rate="lin_0.001", target_noise_clip=0.1), True),
        (dict(policy_delay=2), dict(policy_delay=3, target_update_interval=1), True),
        (dict(learning_starts=10), dict(learning_starts=100), True),
        (NOISE, NOISE | dict(noise_std=0.3), True),
        (NOISE, {}, False),
        (NOISE, NOISE | dict(noise_type="ornstein-uhlenbeck"), False),
        ({}, dict(batch_size=32), False),
        ({}, dict(cem_samples=32), False),
        ({}, dict(n_steps=3), False),
        ({}, dict(policy_kwargs="dict(net_arch=[64])"), False),
        ({}, dict(policy_loss="qgp"), False),
        ({}, dict(policy_training="offline"), False),
        ({}, dict(algo="td3"), False),
        (dict(algo="td3"), dict(algo="td3", tau=0.1), True),
        (dict(algo="ddpg"), dict(algo="ddpg", learning_rate=0.1), True),
        (dict(algo="td3"), dict(algo="ddpg"), False),
        # The entry of Pendulum-v1 sets the same numbers, and other shapes
        (dict(tuned=True), dict(tuned=True, gamma=0.9), True),
        (dict(tuned=True), dict(), False),
    ],
)  # fmt: skip
def test_runs_share_a_process_that_differ_in_numbers_and_seeds_alone(runs_of, a, b, may_share):
    runs = [common_settings(run) for run in runs_of(a, b, seeds=2)]
    assert None not in runs
    # A and B, with two seeds each
    assert runs[:2] == runs[2:]
    assert (runs[0] == runs[1]) == may_share


@pytest.mark.parametrize(
    "hyperparams",
    [
        dict(algo="sac"),
        dict(algo="tqc"),
        dict(algo="crossq"),
        dict(algo="ppo"),
        dict(algo="random"),
        dict(normalize=True),
        dict(n_envs=2),
        dict(frame_stack=2),
        dict(train_freq=[1, "episode"]),
        dict(cem_dtype="bfloat16"),
        dict(optimize_memory_usage=True),
        dict(policy="sb3_cgp.core.policies.CGPPolicy"),
        dict(callback="stable_baselines3.common.callbacks.StopTrainingOnMaxEpisodes"),
    ],
)
def test_runs_that_a_population_cannot_train_are_trained_alone(runs_of, hyperparams):
    shared = {name: value for name, value in hyperparams.items() if name != "algo"}
    assert {common_settings(run) for run in runs_of(hyperparams, {"algo": hyperparams.get("algo", "cgp")} | shared)} == {None}


def test_runs_on_other_tasks_or_of_other_lengths_do_not_share_a_process(runs_of):
    first = runs_of({}, {})
    others = [runs_of({}, {}, steps=2_000, evaluation_interval=50), runs_of({}, {}, evaluation_interval=100),
              runs_of({}, {}, evaluation_episodes=3), runs_of({}, {}, tasks=["MountainCarContinuous-v0"])]  # fmt: skip
    assert len({common_settings(runs[0]) for runs in (first, *others)}) == 5
