"""
The spaces that an exported policy's description holds, in plain JSON: a box, or a Dict of boxes by key.

A description is data from an unknown source: keys, data types and sizes are checked before a space is made of them.
"""

import math
import re
from collections import OrderedDict
from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np
from gymnasium import spaces

from sb3_cgp.common.rules import require, require_choice, require_count

# The spaces of observations that can be exported
ObservationSpace: TypeAlias = spaces.Box | spaces.Dict

# The ONNX input of observations without keys, and the ONNX output
OBSERVATION, ACTION = "observation", "action"
OBSERVATION_DTYPES = ("float32", "float64", "uint8", "int8", "int16", "int32", "int64")
ACTION_DTYPES = ("float32", "float64")
# Larger sizes are refused, as they would exhaust the memory. That of a space is the number of its elements, over all keys
LARGEST_SPACE = 2**24
MOST_KEYS = 256
# Not a full stop, which separates the parts of a tensor's name
KEY = re.compile(r"[A-Za-z0-9_/:-]{1,64}", re.ASCII)
KEYS_ALLOWED = f"1 to 64 of the characters A-Z, a-z, 0-9, _, -, / and :, and not {ACTION!r}, which names the ONNX output"


def describe_box(space: spaces.Box) -> dict[str, Any]:
    """
    Describe a box in plain JSON.

    :param space: the box
    :return: the shape, the data type, and the lower and upper bounds: one number if all are equal, otherwise a list of all in
        C order; None for an infinite bound
    """
    bounds = {}
    for name, values in (("low", space.low), ("high", space.high)):
        numbers = [number if np.isfinite(number) else None for number in values.ravel().tolist()]
        bounds[name] = numbers[0] if len(set(numbers)) == 1 else numbers
    return {"shape": list(space.shape), "dtype": space.dtype.name, **bounds}


def describe_observations(space: ObservationSpace) -> dict[str, Any]:
    """
    Describe an observation space in plain JSON.

    :param space: a box, or a Dict of boxes
    :return: the description of the box; for a Dict, a list of those of its boxes, each with its key, in the Dict's order
    """
    if isinstance(space, spaces.Box):
        return describe_box(space)
    return {"boxes": [{"key": key, **describe_box(box)} for key, box in boxes_of(space).items()]}


def boxes_of(space: ObservationSpace) -> dict[str, spaces.Box]:
    """
    Return the boxes of an observation space by the names of their ONNX inputs.

    :param space: a box, or a Dict of boxes
    :return: the boxes, in the space's order
    """
    boxes: Mapping[str, Any] = space.spaces if isinstance(space, spaces.Dict) else {OBSERVATION: space}
    return dict(boxes)


def is_key(key: Any) -> bool:
    """
    Return whether a key of a Dict space can name an ONNX input.

    :param key: the key
    :return: whether it can
    """
    return isinstance(key, str) and KEY.fullmatch(key) is not None and key != ACTION


def take_fields(value: Any, name: str, keys: tuple[str, ...]) -> list[Any]:
    """
    Return the values of a JSON object that has exactly the given keys.

    :param value: the object
    :param name: its name in errors
    :param keys: its keys
    :return: the values in the order of the keys
    :raises ValueError: if the value is not an object, or has other keys
    """
    require(isinstance(value, dict) and set(value) == set(keys), name, value, f"an object of {', '.join(keys)}")
    return [value[key] for key in keys]


def read_observations(value: Any, name: str) -> ObservationSpace:
    """
    Create the space that :func:`describe_observations` described.

    :param value: the description
    :param name: its name in errors
    :return: the box, or the Dict of boxes
    :raises ValueError: naming an entry that is not allowed
    """
    if not (isinstance(value, dict) and "boxes" in value):
        return read_box(value, name, OBSERVATION_DTYPES)
    (entries,) = take_fields(value, name, ("boxes",))
    is_short = isinstance(entries, list) and 1 <= len(entries) <= MOST_KEYS
    require(is_short, f"{name}.boxes", entries, f"a list of 1 to {MOST_KEYS} objects")
    # Gymnasium sorts the keys of a plain dictionary
    boxes: OrderedDict[str, spaces.Space[Any]] = OrderedDict()
    size_left = LARGEST_SPACE
    for entry in entries:
        key, *_ = take_fields(entry, f"{name}.boxes", ("key", "shape", "dtype", "low", "high"))
        require(is_key(key) and key not in boxes, f"{name}.boxes.key", key, f"{KEYS_ALLOWED}; and there once")
        box = {field: entry[field] for field in ("shape", "dtype", "low", "high")}
        boxes[key] = read_box(box, f"{name}.boxes.{key}", OBSERVATION_DTYPES, size_left)
        size_left -= math.prod(box["shape"])
    return spaces.Dict(boxes)


def read_box(value: Any, name: str, dtypes: tuple[str, ...], largest: int = LARGEST_SPACE) -> spaces.Box:
    """
    Create the box that :func:`describe_box` described.

    :param value: the description
    :param name: its name in errors
    :param dtypes: the data types that are allowed
    :param largest: the largest number of elements that is allowed
    :return: the box
    :raises ValueError: naming an entry that is not allowed
    """
    shape, dtype, low, high = take_fields(value, name, ("shape", "dtype", "low", "high"))
    require(isinstance(shape, list), f"{name}.shape", shape, "a list")
    size = 1
    for length in shape:
        require_count(f"{name}.shape", length)
        size *= length
        require(size <= largest, f"{name}.shape", shape, f"of at most {largest} elements")
    require_choice(f"{name}.dtype", dtype, dtypes)
    bounds = []
    for bound, values, infinity in (("low", low, -np.inf), ("high", high, np.inf)):
        numbers = values if isinstance(values, list) else [values] * size
        require(len(numbers) == size, f"{name}.{bound}", values, f"a number or null, or {size} of them")
        # Not isinstance, because True is an int, too
        are_numbers = all(number is None or type(number) in (int, float) for number in numbers)
        require(are_numbers, f"{name}.{bound}", values, "a number or null, or a list of them")
        bounds.append(np.array([infinity if number is None else number for number in numbers], dtype).reshape(shape))
    require(bool(np.all(bounds[0] <= bounds[1])), name, value, "of low <= high")
    return spaces.Box(bounds[0], bounds[1], tuple(shape), np.dtype(dtype).type)
