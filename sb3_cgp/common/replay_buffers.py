"""What may be assumed of a replay buffer of a user's own class, and the end of a replay buffer's last episode."""

import warnings

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_cgp.common.spaces import by_key

# The packages whose replay buffers store what the model gives them, as it is
OURS = ("stable_baselines3.", "sb3_cgp.")


def is_ours(buffer_class: type) -> bool:
    """
    Return whether a class of replay buffers is SB3's or this package's.

    :param buffer_class: the class
    :return: whether it is
    """
    return buffer_class.__module__.startswith(OURS)


def stores_as_given(buffer_class: type[ReplayBuffer]) -> bool:
    """
    Return whether a class of replay buffers stores what the model gives it, as SB3's classes do.

    :param buffer_class: the class
    :return: False for a user's own class with a constructor or a method ``add`` of its own, which may store anything
    """
    methods = (buffer_class.__init__, buffer_class.add)
    return all(method.__module__.startswith(OURS) for method in methods)


def saves_memory(buffer: ReplayBuffer) -> bool:
    """
    Return whether a replay buffer is of SB3's memory-efficient variant, which stores no next observations.

    :param buffer: the replay buffer, of whatever class
    :return: whether it is
    """
    return bool(getattr(buffer, "optimize_memory_usage", False))


def stores_rows(buffer: ReplayBuffer) -> bool:
    """
    Return whether a replay buffer stores transitions as SB3's do, which a user's own class need not.

    :param buffer: the replay buffer
    :return: whether it has SB3's arrays, or tensors in their place, with a row of all environments for each step
    """
    observations, ends = ["observations", "next_observations"], ["dones", "timeouts"]
    if saves_memory(buffer):
        observations, ends = observations[:1], ends[:1]
    if not all(hasattr(buffer, name) for name in [*observations, *ends, "obs_shape"]):
        return False
    rows = (buffer.buffer_size, buffer.n_envs)
    stored = [by_key(getattr(buffer, name)) for name in observations]
    # SB3's attribute is a dictionary for `Dict` spaces
    shapes = {key: (*rows, *shape) for key, shape in by_key(buffer.obs_shape).items()}
    return all({key: _shape_of(array) for key, array in each.items()} == shapes for each in stored) and all(
        _shape_of(getattr(buffer, name)) == rows for name in ends
    )


def _shape_of(array: object) -> tuple[int, ...] | None:
    return tuple(array.shape) if isinstance(array, np.ndarray | th.Tensor) else None


def end_last_episode(buffer: ReplayBuffer) -> None:
    """
    Mark the episodes that the last row belongs to as truncated after it.

    Buffers that look beyond a row (n-step returns, hindsight goals, the memory-efficient variant) would otherwise take the
    next stored row for its continuation. Sampled one-step transitions stay the same, except in the memory-efficient buffer,
    which overwrites the last next observation. That row becomes a termination, as SB3's own remedy makes it (SB3 issue #46).
    Calling this again has no effect. A buffer of the user's own that stores otherwise is left as it is.

    :param buffer: the replay buffer, which may be empty
    """
    if buffer.size() == 0 or not stores_rows(buffer):
        return
    if isinstance(buffer, HerReplayBuffer):
        with warnings.catch_warnings():
            # SB3 warns of the truncation, which is intended here
            warnings.simplefilter("ignore")
            buffer.truncate_last_trajectory()
        return
    # The row before row 0 is the last one, as the buffer is a ring
    last = buffer.pos - 1
    if not saves_memory(buffer):
        # A timeout where the episode has not ended
        buffer.timeouts[last][buffer.dones[last] == 0] = 1
    buffer.dones[last] = 1
