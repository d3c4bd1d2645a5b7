"""Comparing the observations of environments, models and replay buffers, and where an environment is."""

from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.vec_env import VecEnv


def position_of(env: VecEnv) -> tuple[Any, ...]:
    """
    List objects that SB3's environments replace when they are stepped or reset.

    A ``DummyVecEnv`` keeps the last actions, and the ``info`` of each environment's last reset. A ``SubprocVecEnv`` keeps the
    latter in a new tuple. An environment of another class may keep neither, and is then not noticed to have moved.

    :param env: the environment
    :return: the objects, to be compared by identity
    """
    bare = env.unwrapped
    infos = bare.reset_infos
    return (getattr(bare, "actions", None), *(infos if isinstance(infos, list) else [infos]))


def continues_last_episode(buffer: ReplayBuffer, observations: Any) -> bool:
    """
    Return whether a step from some observations would continue the episodes at a replay buffer's end.

    :param buffer: the replay buffer
    :param observations: the observations of all N environments, not normalised, (N, *shape), by key for ``Dict`` spaces
    :return: whether each episode that has not ended in the buffer's last row goes on from the observation stored there
    """
    if buffer.size() == 0 or buffer.n_envs != count_observations(observations):
        return False
    goes_on = _array(buffer.dones[buffer.pos - 1]) == 0
    stored, row = (
        (buffer.observations, buffer.pos) if buffer.optimize_memory_usage else (buffer.next_observations, buffer.pos - 1)
    )
    if isinstance(stored, dict):
        pairs = [(_array(stored[key][row]), _array(observations[key])) for key in stored]
    else:
        pairs = [(_array(stored[row]), _array(observations))]
    return all(
        np.array_equal(last[goes_on], new.reshape(last.shape).astype(last.dtype)[goes_on], equal_nan=True)
        for last, new in pairs
    )


def _array(values: Any) -> np.ndarray:
    return values.numpy(force=True) if isinstance(values, th.Tensor) else np.asarray(values)


def count_observations(observations: Any) -> int | None:
    """
    Return the number of environments that observations are of.

    :param observations: the observations, (N, *shape), by key for ``Dict`` spaces
    :return: N; None if there are no observations
    """
    first = next(iter(observations.values())) if isinstance(observations, dict) else observations
    return None if first is None else len(first)


def copy_observations(observations: Any) -> Any:
    """
    Copy observations.

    :param observations: an array, or arrays by key
    :return: the copy
    """
    if isinstance(observations, dict):
        return {key: np.copy(value) for key, value in observations.items()}
    return np.copy(observations)


def same_observations(first: Any, second: Any) -> bool:
    """
    Return whether observations are equal.

    :param first: an array, or arrays by key
    :param second: an array, or arrays by key, all of which are compared
    :return: whether shapes and values are equal
    """
    if isinstance(second, dict):
        return all(same_observations(first[key], value) for key, value in second.items())
    return np.shape(first) == np.shape(second) and np.array_equal(first, second)
