"""Transitions that a user has put into a replay buffer, which have not passed the checks of an environment's transitions."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer

from sb3_cgp.common.replay_buffers import stores_as_given
from sb3_cgp.common.spaces import by_key

# Rows that are checked at a time, for the memory that the check takes
ROWS = 10_000
SCALED = "scaled to [-1, 1]: add `model.policy.scale_action(action)`, of actions within the bounds of the action space"


def check_contents(buffer: ReplayBuffer) -> None:
    """
    Check that the numbers in a replay buffer are finite, and actions scaled.

    :param buffer: the replay buffer; one of a user's own class that stores in its own way is not checked
    :raises ValueError: naming the array, the first row that breaks the rule, and the remedy
    """
    if not stores_as_given(type(buffer)):
        return
    size = buffer.size()
    for name, array in _arrays(buffer):
        is_float = array.is_floating_point() if isinstance(array, th.Tensor) else array.dtype.kind == "f"
        if not is_float:
            continue
        is_scaled = name == "actions" and isinstance(buffer.action_space, spaces.Box)
        for first in range(0, size, ROWS):
            rows: Any = array[first : min(first + ROWS, size)]
            # The extremes of rows with NaN are NaN
            if not (_is_right(rows.min(), is_scaled) and _is_right(rows.max(), is_scaled)):
                is_wrong = ~_is_right(rows, is_scaled)
                row = int(th.as_tensor(is_wrong).nonzero()[0][0])
                allowed = SCALED if is_scaled else "finite: leave out the transition"
                value = rows[is_wrong][0]
                raise ValueError(f"The value in `replay_buffer.{name}[{first + row}]` is {value}, but must be {allowed}.")


def _is_right(values: Any, is_scaled: bool) -> Any:
    """Return whether numbers are finite, or those of scaled actions within [-1, 1]. A comparison with NaN is false."""
    return abs(values) <= 1.0 + 1e-6 if is_scaled else abs(values) < np.inf


def _arrays(buffer: ReplayBuffer) -> Iterator[tuple[str, np.ndarray | th.Tensor]]:
    """Yield the arrays of transitions, those of ``Dict`` observations by key; of a buffer on a GPU, the tensors."""
    for name in ("observations", "next_observations", "actions", "rewards"):
        # A memory-efficient buffer has no next observations
        value: Any = getattr(buffer, name, None)
        for key, array in by_key(value).items():
            if isinstance(array, np.ndarray | th.Tensor):
                yield name if key is None else f"{name}['{key}']", array
