"""Action and observation spaces, as acting, training and exported policies share them."""

from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_cgp.common.rules import require


def check_action_space(action_space: spaces.Space[Any]) -> None:
    """
    Check that actions can be scaled to [-1, 1] and back: a Box of floating point numbers, bounded in every dimension.

    :param action_space: the environment's action space
    :raises ValueError: if it is of another kind or dtype, empty, unbounded, or so wide that ``high - low`` overflows its dtype
    """
    allowed = "a gymnasium.spaces.Box; for Discrete actions take DQN or PPO of Stable-Baselines3"
    require(isinstance(action_space, spaces.Box), "action_space", action_space, allowed)
    assert isinstance(action_space, spaces.Box)
    require(
        np.issubdtype(action_space.dtype, np.floating),
        "action_space",
        action_space,
        "of a floating point dtype, such as float32, as the replay buffer stores actions scaled to [-1, 1] in it: give the "
        "environment such a space, and let it round the actions",
    )
    low, high = action_space.low, action_space.high
    is_bounded = low.size > 0 and bool(np.all(np.isfinite(low)) and np.all(np.isfinite(high)) and np.all(low < high))
    require(is_bounded, "action_space", action_space, "bounded: finite low < high in every dimension, and at least one")
    # SB3 scales actions in the space's own dtype
    with np.errstate(over="ignore"):
        is_scalable = bool(np.all(np.isfinite(high - low)))
    allowed = f"of bounds whose difference `high - low` is finite in {action_space.dtype}: give the environment closer bounds"
    require(is_scalable, "action_space", action_space, allowed)


def by_key(whole: Any) -> dict[Any, Any]:
    """
    Return the parts of a ``Dict`` space, or of observations of one.

    :param whole: a space, or observations
    :return: the parts by key; another space, or an array, as a whole by None
    """
    parts = whole.spaces if isinstance(whole, spaces.Dict) else whole
    return parts if isinstance(parts, dict) else {None: parts}


def have_same_layout(space: spaces.Space[Any], other: spaces.Space[Any]) -> bool:
    """
    Return whether values of two spaces have the same keys and shapes, and are both integers or both floats.

    :param space: a space
    :param other: another space
    :return: whether they have, whatever their bounds; whether the spaces are equal where they are of other kinds
    """
    if isinstance(space, spaces.Dict) and isinstance(other, spaces.Dict):
        return space.keys() == other.keys() and all(have_same_layout(space[key], other[key]) for key in space)
    if isinstance(space, spaces.Box) and isinstance(other, spaces.Box):
        return space.shape == other.shape and np.dtype(space.dtype).kind == np.dtype(other.dtype).kind
    return space == other


def sample_of(space: spaces.Space[Any]) -> Any:
    """
    Draw a random observation, also from a float64 ``Box`` whose bounds are so wide that Gymnasium's ``sample`` overflows.

    Bounds beyond float32, in which observations are replayed, count as none.

    :param space: the observation space, whose random numbers are used
    :return: the observation
    """
    if isinstance(space, spaces.Dict):
        return {key: sample_of(subspace) for key, subspace in space.items()}
    largest = np.finfo(np.float32).max
    if not isinstance(space, spaces.Box) or space.dtype != np.float64:
        return space.sample()
    low, high = np.where(space.low < -largest, -np.inf, space.low), np.where(space.high > largest, np.inf, space.high)
    return spaces.Box(low, high, dtype=np.float64, seed=space.np_random).sample()
