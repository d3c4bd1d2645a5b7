"""Ending a replay buffer's last episode, whose environment was reset without a transition being stored."""

import warnings

from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer


def stores_rows(buffer: ReplayBuffer) -> bool:
    """
    Return whether a replay buffer stores transitions as SB3's do, which a user's own class need not.

    :param buffer: the replay buffer
    :return: whether it has SB3's arrays
    """
    saves_memory = getattr(buffer, "optimize_memory_usage", False)
    names = ("observations", "dones") if saves_memory else ("next_observations", "dones", "timeouts")
    return all(hasattr(buffer, name) for name in names)


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
    if not buffer.optimize_memory_usage:
        # A timeout where the episode has not ended. Arithmetic, as the fields may be arrays or tensors.
        buffer.timeouts[last] = 1 - (1 - buffer.timeouts[last]) * buffer.dones[last]
    buffer.dones[last] = 1
