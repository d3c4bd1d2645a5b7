"""The check of another package's environment: what it compares."""

import json
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from benchmark.compatibility import check, checking
from benchmark.compatibility.checking import summary
from benchmark.compatibility.package_types import Environment, Learning

COUNTS = """
import gymnasium as gym
import numpy as np


class Counts(gym.Env):
    observation_space = gym.spaces.Box(-9.0, 9.0, (2,), np.float32)
    action_space = gym.spaces.Box(-2.0, 2.0, (1,), np.float32)
    count = 0.0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = self.np_random.uniform()
        return self.observe(), {}

    def step(self, action):
        self.count += 0.01 * float(action[0]) + 0.001
        return self.observe(), self.count, False, False, {}

    def observe(self):
        return np.array([np.sin(self.count), self.count], np.float32)
"""
LIMITED = "\n\nenv = gym.wrappers.TimeLimit(Counts(), 25)"
METHODS = """
    def get_training_state(self):
        return self.count

    def set_training_state(self, state):
        self.count = {restored}
"""
UNSEEDED = COUNTS.replace("self.np_random.uniform()", "np.random.default_rng().uniform()")


@pytest.fixture
def short(monkeypatch):
    for name, value in dict(LEARNING_STARTS=30, STOP=43, STEPS=60, WARM_UP=2, ALONE=20, EPISODES=2).items():
        monkeypatch.setattr(check, name, value)
    small = dict(policy_kwargs=dict(net_arch=[8]), batch_size=8, cem_samples=8, cem_elites=2)
    monkeypatch.setattr(check, "DEFAULTS", check.DEFAULTS | small)


def checked(folder: Path, code: str, *parts: str, **fields: object) -> dict:
    """Carry out parts of the check in this process, and summarise them."""
    found = {}
    for part in parts:
        report = check.Report(folder / f"{part}.json")
        getattr(check, part)(asdict(Environment("Counts", code, **fields)), folder, report)
        found[part] = json.loads((folder / f"{part}.json").read_text())
    return summary(found)


@pytest.mark.parametrize(
    ("code", "resumes", "repeats"),
    [
        (COUNTS + METHODS.format(restored="state"), "bit for bit", True),
        (COUNTS + METHODS.format(restored="state + 0.01"), "differs", True),
        (COUNTS, "from a new episode", True),
        (UNSEEDED + METHODS.format(restored="state"), "differs", False),
    ],
)
def test_resumption_is_compared_to_the_bit(code, resumes, repeats, short, tmp_path, monkeypatch):
    monkeypatch.setattr(check.CGP, "export", lambda *_: 1 / 0)
    row = checked(tmp_path, code + LIMITED, "whole", "stopped", "resumed")
    assert (row["resumes"], row["repeats"]) == (resumes, repeats)
    assert row["errors"] == {"whole": {"exports": "ZeroDivisionError: division by zero"}}
    assert (row["why_not_restorable"] is None) == (resumes != "from a new episode")
    assert row["steps_per_second"] > 0
    assert row["environment_steps_per_second"] > row["steps_per_second"]


def test_an_export_is_compared_with_predict(short, tmp_path, monkeypatch):
    load_weights = check.CGP.load_weights

    class Shifted:
        """An exported policy that acts otherwise by a tenth of the width of the action space."""

        def __init__(self, folder):
            self.policy = load_weights(folder)

        def predict(self, observations):
            return self.policy.predict(observations)[0] + 0.4, None

    monkeypatch.setattr(check.CGP, "load_weights", Shifted)
    row = checked(tmp_path, COUNTS + LIMITED, "whole")
    assert row["errors"] == {}
    np.testing.assert_allclose(row["export_difference"], 0.1, atol=1e-5)


def test_what_raises_is_named_and_ends_the_check(short, tmp_path):
    row = checked(tmp_path, COUNTS.replace("self.count, False", "1 / 0, False") + LIMITED, "whole")
    assert row["errors"] == {"whole": {"trains": "ZeroDivisionError: division by zero"}}
    row = checked(tmp_path, "import a_package_that_is_not_there", "whole")
    assert row["errors"] == {"whole": {"trains": "ModuleNotFoundError: No module named 'a_package_that_is_not_there'"}}


def test_learning_is_returns_beside_those_of_random_actions(short, tmp_path):
    learning = Learning(50, dict(learning_starts=30, gamma=0.9), normalize=True)
    code = COUNTS.replace("False, False, {}", "False, False, {'is_success': True}") + LIMITED
    code += "\n\nfrom stable_baselines3.common.vec_env import DummyVecEnv\n\none = env\nenv = DummyVecEnv([lambda: one])"
    found = check.Report(tmp_path / "learnt.json")
    check.learnt(asdict(Environment("Counts", code, learning=learning)), tmp_path, found)
    assert [len(found.known[key]) for key in ("returns", "random_returns")] == [2, 2]
    assert (found.known["successes"], found.known["random_successes"]) == (2, 2)
    assert found.known["learning_seconds"] > 0


def test_the_script_runs_outside_of_the_repository(tmp_path):
    """It imports nothing of ``benchmark``, and writes an error where the environment cannot be made."""
    row = checking.check(Environment("Nothing", "import nothing_here"), Path(sys.executable), tmp_path / "check", 300)
    assert row["errors"] == {"whole": {"trains": "ModuleNotFoundError: No module named 'nothing_here'"}}
    assert row["resumes"] is None
    assert "stable-baselines3" in row["versions"]
