"""States of users' environments, which take part in the protocol, or do not."""

import re
from collections import deque
from functools import partial
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from environment_states import PENDULUM, check, environment_state, obstacles
from environments import Doubles
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecExtractDictObs, VecFrameStack, VecNormalize, VecTransposeImage

from sb3_cgp.resumption.environments import restore_environment


class Goal(Doubles):
    """A user's environment of dictionaries and images, whose state is not in plain attributes alone."""

    observation_space = spaces.Dict(
        vector=spaces.Box(-np.inf, np.inf, (3,), np.float32), image=spaces.Box(0, 255, (36, 36, 3), np.uint8)
    )

    def __init__(self):
        self.action_space = spaces.Box(-1, 1, (2,), np.float32)
        self.simulator = SimpleNamespace(position=0.0, visited={})

    def observe(self):
        vector = self.np_random.normal(size=3).astype(np.float32) + np.float32(self.simulator.position)
        return dict(vector=vector, image=self.np_random.integers(0, 256, (36, 36, 3), np.uint8))

    def step(self, action):
        self.simulator.position += float(action.sum())
        self.simulator.visited[self.steps, 0] = self.simulator.position
        observation, _, *ends, info = super().step(action)
        return observation, sum(self.simulator.visited.values()), *ends, info | dict(visited=len(self.simulator.visited))

    def get_training_state(self):
        return dict(steps=getattr(self, "steps", None), **vars(self.simulator))

    def set_training_state(self, state):
        self.steps = state.pop("steps")
        vars(self.simulator).update(state)


class Inherits(Doubles):
    """Without the two methods."""


def make_goal(seed, environment=Goal, wrap=lambda env: env):
    env = wrap(DummyVecEnv([environment, environment]))
    env.seed(seed)
    return env


@pytest.mark.parametrize(
    "wrap",
    [
        lambda env: env,
        VecTransposeImage,
        lambda env: VecFrameStack(env, 3),
        lambda env: VecNormalize(env, norm_obs_keys=["vector"]),
        lambda env: VecNormalize(VecExtractDictObs(env, "vector")),
    ],
    ids=["plain", "VecTransposeImage", "VecFrameStack", "VecNormalize", "VecExtractDictObs"],
)
def test_users_environments_that_take_part_go_on_to_the_bit(wrap):
    check(partial(make_goal, wrap=wrap), steps=13, then=22)


def test_users_environments_and_wrappers_that_do_not_take_part_are_not_restorable():
    assert environment_state(make_goal(1, Inherits)) is None
    assert "Inherits is unknown and has no get_training_state()" in " ".join(obstacles(make_goal(1, Inherits)))
    assert environment_state(PENDULUM(1, wrapper_class=type("Wrapper", (gym.Wrapper,), {}))) is None
    assert environment_state(type("Wrapper", (VecNormalize,), {})(PENDULUM(1))) is None
    with pytest.raises(ValueError, match=r"`env` is .*, but must be restorable"):
        restore_environment(make_goal(1, Inherits), environment_state(make_goal(1)))


def test_state_that_is_no_plain_data_is_noticed():
    env = PENDULUM(1)
    assert environment_state(env) is not None
    env.envs[1].unwrapped.goal = SimpleNamespace()
    assert environment_state(env) is None
    assert re.fullmatch(r".*PendulumEnv\.goal is namespace\(\), which is not plain data\.", " ".join(obstacles(env)))
    env.envs[1].unwrapped.goal = env.action_space
    assert environment_state(env) is not None
    env.simulator = deque([object()])
    assert environment_state(env) is None


def test_infos_may_hold_anything():
    env = make_goal(1)
    env.reset_infos = [{"simulator": object()}] * 2
    assert environment_state(env) is not None


def test_a_user_may_decline_and_must_return_plain_data(monkeypatch):
    env = make_goal(1)
    monkeypatch.setattr(Goal, "get_training_state", lambda self: None)
    assert environment_state(env) is None
    monkeypatch.setattr(Goal, "get_training_state", lambda self: self.simulator)
    with pytest.raises(ValueError, match=r"Goal\.get_training_state\(\) returned namespace.* must return plain data"):
        environment_state(env)
