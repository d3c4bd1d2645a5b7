"""Comparing the observations of environments, models and replay buffers, and where an environment is."""

from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium.wrappers import TimeLimit
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecEnvWrapper

from sb3_cgp.common.replay_buffers import saves_memory, stores_rows
from sb3_cgp.common.spaces import by_key


def innermost(env: VecEnv | None) -> Any:
    """
    Return the vectorised environment within SB3's wrappers.

    ``VecEnv.unwrapped`` would be what a wrapper of another package says, which may be its simulator.

    :param env: the environment, if there is one
    :return: the innermost ``VecEnv``
    """
    while isinstance(env, VecEnvWrapper) and isinstance(vars(env).get("venv"), VecEnv):
        env = env.venv
    return env


def position_of(env: VecEnv) -> tuple[Any, ...]:
    """
    List what tells whether an environment was stepped or reset: objects, which SB3's environments replace, and counters.

    A ``DummyVecEnv`` keeps the last actions, and the ``info`` of each environment's last reset. A ``SubprocVecEnv`` keeps the
    latter in a new tuple. The environments within a ``DummyVecEnv``, which others may step too, have SB3's ``Monitor``, which
    lists the rewards of an episode, or Gymnasium's ``TimeLimit``, which counts its steps. Vectorised environments of other
    packages are not known to do so.

    :param env: the environment
    :return: the objects and counters, to be compared by :func:`same_position`; none for other packages' environments
    """
    bare = innermost(env)
    if not isinstance(bare, DummyVecEnv | SubprocVecEnv):
        return ()
    # A subclass may compute them anew for each reader
    infos = vars(bare).get("reset_infos")
    position = [vars(bare).get("actions"), *(infos if isinstance(infos, list) else [infos])]
    if isinstance(bare, DummyVecEnv):
        for each in bare.envs:
            position += _marks(each)
    return tuple(position)


def _marks(env: gym.Env) -> list[Any]:
    """List what changes in an environment's wrappers when they are stepped or reset."""
    marks: list[Any] = []
    while isinstance(env, gym.Wrapper):
        if isinstance(env, Monitor):
            # A new list in each episode. Not `total_steps`, a name that `VecEnv.set_attr` may set for the environment within.
            marks += [env.rewards, len(env.rewards)]
        if isinstance(env, TimeLimit):
            # Gymnasium has no public attribute for it
            marks.append(env._elapsed_steps)
        env = env.env
    return marks


def same_position(first: tuple[Any, ...], second: tuple[Any, ...]) -> bool:
    """
    Return whether two positions are the same: counters are compared by value, objects by identity.

    :param first: what :func:`position_of` returned
    :param second: what it returned another time
    :return: whether the environment has not moved in between
    """
    return len(first) == len(second) and all(
        each == other if type(each) is int else each is other for each, other in zip(first, second, strict=True)
    )


def continues_last_episode(buffer: ReplayBuffer, observations: Any) -> bool:
    """
    Return whether a step from some observations would continue the episodes at a replay buffer's end.

    :param buffer: the replay buffer
    :param observations: the observations of all N environments, not normalised, (N, *shape), by key for ``Dict`` spaces
    :return: whether each episode that has not ended in the buffer's last row goes on from the observation stored there
    """
    if buffer.size() == 0 or not stores_rows(buffer) or buffer.n_envs != count_envs(observations):
        return False
    goes_on = _array(buffer.dones[buffer.pos - 1]) == 0
    stored, row = (buffer.observations, buffer.pos) if saves_memory(buffer) else (buffer.next_observations, buffer.pos - 1)
    last = {key: _array(each[row]) for key, each in by_key(stored).items()}
    shown = {key: _array(each) for key, each in by_key(observations).items() if key in last}
    # A user's own class may store something else of them
    return all(key in shown and shown[key].size == each.size for key, each in last.items()) and all(
        np.array_equal(each[goes_on], shown[key].reshape(each.shape).astype(each.dtype)[goes_on], equal_nan=True)
        for key, each in last.items()
    )


def _array(values: Any) -> np.ndarray:
    return values.numpy(force=True) if isinstance(values, th.Tensor) else np.asarray(values)


def count_envs(observations: Any) -> int | None:
    """
    Return the number of environments that observations are of.

    :param observations: the observations, (N, *shape), by key for ``Dict`` spaces
    :return: N; None if there are no observations
    """
    first = next(iter(by_key(observations).values()))
    return None if first is None else len(first)


def same_observations(first: Any, second: Any) -> bool:
    """
    Return whether observations are equal.

    :param first: an array, or arrays by key
    :param second: an array, or arrays by key, all of which are compared
    :return: whether shapes and values are equal
    """
    return all(np.array_equal(by_key(first)[key], value) for key, value in by_key(second).items())
