"""Observations that do not fit their space: without a key, of another shape, or beyond its integers."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_cgp.common.spaces import by_key

RETURN_EVERY_KEY = "Return every key of the observation space from `reset` and `step`, or remove it from the space."


def check_shape(name: str, values: Any, space: spaces.Space, n_envs: int | None, timestep: int | None) -> None:
    """
    Refuse observations without a key of their space, or of another shape, which NumPy may broadcast to it.

    :param name: the name of the values, for the error
    :param values: the observations of all environments, or of one
    :param space: the observation space
    :param n_envs: number of environments; None for the observation of one
    :param timestep: the environment step; None if it is not known, as in an environment's process
    :raises ValueError: naming the keys, or the shape and the one that is expected
    """
    batch = () if n_envs is None else (n_envs,)
    for key, subspace in by_key(space).items():
        if key is not None and not (isinstance(values, Mapping) and key in values):
            has = list(values) if isinstance(values, Mapping) else f"{type(values).__name__} without keys"
            raise ValueError(
                f"The environment returned an incomplete {name}{_at(timestep)}: {has}, where its space has "
                f"the keys {list(by_key(space))}. It was not stored. {RETURN_EVERY_KEY}"
            )
        part, which = _part(values, name, key)
        shape, expected = np.shape(part), (*batch, *(subspace.shape or ()))
        if shape != expected and not _can_be_collected(shape, expected):
            raise wrong_shape(which, shape, expected, timestep)


def check_integers(name: str, values: Any, space: spaces.Space, timestep: int | None) -> None:
    """
    Refuse values that NumPy would round or wrap to the integers of their space, or that its one-hot code has not.

    :param name: the name of the values, for the error
    :param values: the observations of all environments, or of one, not normalised
    :param space: the observation space
    :param timestep: the environment step; None if it is not known, as in an environment's process
    :raises ValueError: naming the value, and what is expected
    """
    for key, subspace in by_key(space).items():
        if subspace.dtype is not None and subspace.dtype.kind in "bui":
            part, which = _part(values, name, key)
            _check_range(which, np.asarray(part), subspace, timestep)


def _part(values: Any, name: str, key: str | None) -> tuple[Any, str]:
    """Return the values of a key, and their name; None is the key of a space without keys."""
    return (values, name) if key is None else (values[key], f"{name} `{key}`")


def wrong_shape(name: str, shape: tuple[int, ...], expected: tuple[int, ...], timestep: int | None) -> ValueError:
    """
    Return the error for values of a wrong shape.

    :param name: the name of the values
    :param shape: their shape
    :param expected: the shape that is expected
    :param timestep: the environment step; None if it is not known, as in an environment's process
    :return: the error
    """
    message = f"The environment returned an array of a wrong shape{_at(timestep)}"
    return ValueError(f"{message}: the {name} has shape {shape}, where {expected} is expected. It was not stored.")


def _at(timestep: int | None) -> str:
    return "" if timestep is None else f" at environment step {timestep}"


def _can_be_collected(shape: tuple[int, ...], expected: tuple[int, ...]) -> bool:
    """Return whether NumPy assigns an array of one shape to one of another, and neither loses nor repeats a number."""
    # NumPy may drop leading axes of length 1, or add them
    if _without_leading_ones(shape) != _without_leading_ones(expected):
        return False
    try:
        np.zeros((1, *expected))[0] = np.zeros(shape)
    except (TypeError, ValueError):
        # From version 2.4 on, an array of one element is no number
        return False
    return True


def _without_leading_ones(shape: tuple[int, ...]) -> tuple[int, ...]:
    n_ones = next((index for index, length in enumerate(shape) if length != 1), len(shape))
    return shape[n_ones:]


def _check_range(name: str, values: np.ndarray, space: spaces.Space, timestep: int | None) -> None:
    if values.dtype.kind not in "buif" or (isinstance(space, spaces.Box) and np.can_cast(values.dtype, space.dtype)):
        return
    low, high = _range(space)
    with np.errstate(invalid="ignore"):
        if isinstance(space, spaces.Box) and space.dtype != np.bool_:
            # Ten times as fast for an image
            fits = values.astype(space.dtype) == values
        else:
            fits = (values >= low) & (values <= high) & (values % 1 == 0)
    if not fits.all():
        index = tuple(np.argwhere(~fits)[0].tolist())
        # A scalar may stand for an array of one element
        value, highest = (each[index] for each in np.broadcast_arrays(values, high))
        raise ValueError(
            f"The {name} that the environment returned{_at(timestep)} has the value {value} at index "
            f"{index}, where its space, {space}, has integers from {low} to {highest}. It was "
            "not stored. Correct the environment's `observation_space`; a wrapper that changes observations, such as one that "
            "scales images to [0, 1], has to set its own."
        )


def _range(space: spaces.Space) -> tuple[int, Any]:
    """Return the smallest and the largest values of a space; a ``Box`` may hold all of its data type."""
    if isinstance(space, spaces.Discrete):
        return 0, space.n - 1
    if isinstance(space, spaces.MultiDiscrete):
        return 0, space.nvec - 1
    if isinstance(space, spaces.MultiBinary) or space.dtype == np.bool_:
        return 0, 1
    limits = np.iinfo(space.dtype)
    return limits.min, limits.max
