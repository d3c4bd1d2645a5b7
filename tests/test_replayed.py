"""Environments whose simulator's state is out of reach are restored by repeating their episode."""

from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from environment_states import assert_plain, check, environment_state, obstacles, start
from environments import Doubles
from gymnasium import spaces
from rl_zoo3.utils import get_wrapper_class
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv
from trainings import Training, assert_same, fingerprint

from sb3_cgp import RestorableEnv
from sb3_cgp.resumption import ReplayedEnv, replayed
from sb3_cgp.resumption.environments import restore_environment
from sb3_cgp.resumption.plain_data import to_plain


class Simulator:
    """A state that nobody can read: it is in a closure."""

    def __init__(self, position):
        def move(by):
            nonlocal position
            position = 0.9 * position + by
            return position

        self.move = move


class Closed(gym.Env):
    """Depends on its actions, and on what was drawn at its reset and since."""

    observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float64)
    action_space = spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.simulator = Simulator(self.np_random.normal())
        return np.array([self.simulator.move(0.0)]), {}

    def step(self, action):
        position = self.simulator.move(float(action[0]) + 0.1 * self.np_random.normal())
        action[:] = 0.0
        return np.array([position]), position, abs(position) > 3.0, False, {}


class Remembers(Doubles):
    """Depends on what was before its reset."""

    total = 0.0

    def step(self, action):
        self.total += float(action.sum())
        return np.full(3, self.total), *super().step(action)[1:]


def make(environment, seed, n_envs=2, wrapper_class=replayed, limit=9, **kwargs):
    return make_vec_env(
        lambda: gym.wrappers.TimeLimit(gym.wrappers.StickyAction(environment(), 0.3), limit),
        n_envs,
        seed,
        wrapper_class=wrapper_class,
        **kwargs,
    )


@pytest.mark.parametrize("steps", [0, 1, 26])
def test_a_deterministic_environment_goes_on_to_the_bit(steps):
    assert "Closed is unknown" in " ".join(obstacles(make(Closed, 1, wrapper_class=None)))
    check(partial(make, Closed), steps=steps, then=30)


def test_it_goes_on_to_the_bit_in_another_process():
    wrapper_class = get_wrapper_class(dict(env_wrapper=["sb3_cgp.resumption.replayed", "sb3_cgp.RestorableEnv"]))
    subprocesses = dict(vec_env_cls=SubprocVecEnv, vec_env_kwargs=dict(start_method="fork"))
    check(partial(make, Closed, n_envs=1, wrapper_class=wrapper_class, **subprocesses), steps=13, then=22)
    assert isinstance(wrapper_class(Closed()), RestorableEnv)


def test_a_training_resumes_to_the_bit(tmp_path):
    results = []
    for name, stops in (("straight", ()), ("stopped", (33,))):
        training = Training(
            tmp_path / name, env=lambda: replayed(gym.wrappers.TimeLimit(Closed(), 12)), steps=50, eval_freq=30
        )
        results.append(fingerprint(training, training.run(*stops)))
    assert_same(*results)


def test_options_of_a_reset_are_repeated_and_what_is_no_plain_data_is_refused():
    env = ReplayedEnv(Closed())
    env.reset(seed=3, options={"any": 1})
    assert_plain(to_plain(env.get_training_state()))
    assert env.get_training_state()["episode"]["arguments"] == {"seed": 3, "options": {"any": 1}}
    env.reset(options={"any": object()})
    assert env.get_training_state() is None


def test_an_environment_that_is_not_deterministic_is_noticed():
    state = environment_state(start(make(Remembers, 1), 13))
    with pytest.warns(UserWarning, match="that was repeated led to another observation than the saved one"):
        restore_environment(make(Remembers, 2), state)


def test_the_wrapper_goes_within_all_others_and_once():
    env = replayed(replayed(make(Closed, 1, n_envs=1).envs[0]))
    names = []
    while isinstance(env, gym.Wrapper):
        # rl_zoo3 replaces Gymnasium's by its own
        names.append(type(env).__name__.removeprefix("Patched"))
        env = env.env
    assert names == ["Monitor", "TimeLimit", "StickyAction", "ReplayedEnv"]
    with pytest.raises(ValueError, match="must be an environment without wrappers"):
        ReplayedEnv(gym.wrappers.TimeLimit(Closed(), 3))


@pytest.mark.parametrize("task", ["LunarLanderContinuous-v3", "BipedalWalker-v3", "BipedalWalkerHardcore-v3"])
def test_box2d_goes_on_to_the_bit(task):
    pytest.importorskip("Box2D", reason="Box2D is not installed")
    check(lambda seed: make_vec_env(task, 1, seed, wrapper_class=replayed), steps=250, then=150)
