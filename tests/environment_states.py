"""Expectations of environments that are restored: they go on as the original does, to the bit."""

import warnings
from collections import deque
from copy import deepcopy
from functools import partial

import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env

from sb3_cgp.resumption.environments import restore_environment, state_and_obstacles

PLAIN_SCALARS = (type(None), bool, int, float, str, bytes)


def assert_same(one, other):
    """Compare two values to the bit, their types and their order included."""
    assert type(one) is type(other)
    if isinstance(one, dict):
        assert list(one) == list(other)
        one, other = one.values(), other.values()
    if isinstance(one, np.ndarray | np.generic):
        assert (one.dtype, one.shape) == (other.dtype, other.shape)
        assert one.tobytes() == other.tobytes()
    elif isinstance(one, list | tuple | deque | type({}.values())):
        assert len(one) == len(other)
        for pair in zip(one, other, strict=True):
            assert_same(*pair)
    else:
        assert repr(one) == repr(other)


def assert_plain(value):
    """Expect nothing that JSON and arrays could not hold."""
    if type(value) is dict:
        assert all(type(key) in (str, int) for key in value)
        value = list(value.values())
    if type(value) in (list, tuple):
        for each in value:
            assert_plain(each)
    elif type(value) is np.ndarray or isinstance(value, np.generic):
        assert value.dtype.kind in "biufc"
    else:
        assert type(value) in PLAIN_SCALARS


def go_on(env, steps):
    """Act at random, by the environment's own action space, and note all that it returns."""
    # Humanoid's are views of the simulator's memory before Gymnasium 1.4
    env.reset_infos = deepcopy(env.reset_infos)
    seen = []
    for _ in range(steps):
        actions = np.stack([env.action_space.sample() for _ in range(env.num_envs)])
        seen.append(deepcopy((actions, *env.step(actions), env.reset_infos)))
        for info in seen[-1][4]:
            # Time on the clock
            info.get("episode", {}).pop("t", None)
    return [*seen, deepcopy(env.reset()), [env.action_space.sample(), env.observation_space.sample()]]


def environment_state(env):
    """Return the state of an environment, or None if it cannot be restored."""
    return state_and_obstacles(env)[0]


def obstacles(env):
    """Return what prevents an environment from being restored."""
    return state_and_obstacles(env)[1]


def start(env, steps):
    env.action_space.seed(3)
    env.observation_space.seed(4)
    env.reset()
    go_on(env, steps)
    # `go_on` ends with a reset
    for _ in range(steps % 10):
        env.step(np.stack([env.action_space.sample() for _ in range(env.num_envs)]))
    return env


def check(make, steps=47, then=60):
    """Expect that a fresh and a used environment go on as the original does; ``make`` takes a seed."""
    original, fresh, used = start(make(5), steps), make(None), start(make(6), 13)
    try:
        state = environment_state(original)
        assert obstacles(original) == []
        assert_plain(state)
        copy = deepcopy(state)
        expected = go_on(original, then)
        assert_same(state, copy)
        other = environment_state(used)
        for env in (fresh, used):
            with warnings.catch_warnings():
                # It was made with the same arguments
                warnings.simplefilter("error", UserWarning)
                restore_environment(env, state)
            assert_same(environment_state(env), copy)
            assert_same(go_on(env, then), expected)
        assert_same(state, copy)
        restore_environment(used, other)
        with pytest.raises(AssertionError):
            assert_same(go_on(used, then), expected)
    finally:
        for env in (original, fresh, used):
            env.close()


def make_task(task, seed, n_envs=2, limit=70, **kwargs):
    return make_vec_env(task, n_envs, seed, env_kwargs=dict(max_episode_steps=limit), **kwargs)


PENDULUM = partial(make_task, "Pendulum-v1", limit=20)
