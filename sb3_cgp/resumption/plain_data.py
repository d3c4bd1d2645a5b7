"""Convert the attributes of objects to plain data, which a training state can hold, and back."""

from collections import Counter, OrderedDict, defaultdict, deque
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
from gymnasium.wrappers.utils import RunningMeanStd as GymnasiumRunningMeanStd
from stable_baselines3.common.running_mean_std import RunningMeanStd

from sb3_cgp.common.rules import require

# The key of a dictionary that represents another type; its value is the name of the type
TYPE = "__type__"
SCALARS = (type(None), bool, int, float, str, bytes)
# The kinds of NumPy's boolean and numeric data types
NUMERIC = "biufc"
COLLECTIONS: dict[str, Any] = {kind.__name__: kind for kind in (deque, set, frozenset)}
UNORDERED = (set.__name__, frozenset.__name__)
MAPPINGS: dict[str, Any] = {kind.__name__: kind for kind in (dict, OrderedDict, Counter)}
# What a defaultdict gives a new key
FACTORIES: dict[str, Any] = {kind.__name__: kind for kind in (bool, int, float, str, list, tuple, dict, set, deque)}
STATISTICS: dict[str, Any] = {
    "stable_baselines3.RunningMeanStd": RunningMeanStd,
    "gymnasium.RunningMeanStd": GymnasiumRunningMeanStd,
}
BIT_GENERATORS: dict[str, Any] = {
    kind.__name__: kind
    for kind in (np.random.MT19937, np.random.PCG64, np.random.PCG64DXSM, np.random.Philox, np.random.SFC64)
}


class NotPlainError(TypeError):
    """A value cannot be represented as plain data."""


def plain_attributes(obj: Any, without: Collection[str] = ()) -> dict[str, Any]:
    """
    Copy the attributes of an object that can be represented as plain data (see :func:`to_plain`). Omit all others.

    :param obj: the object
    :param without: the names of attributes to omit
    :return: the plain data of each attribute, by name
    """
    state = {}
    for name, value in vars(obj).items():
        if name not in without:
            try:
                state[name] = to_plain(value)
            except (NotPlainError, RecursionError):
                # A list that contains itself raises RecursionError
                continue
    return state


def set_plain_attributes(obj: Any, state: Mapping[str, Any]) -> None:
    """
    Restore the attributes that :func:`plain_attributes` copied. Attributes that ``state`` does not name are not changed.

    The object's ``__setattr__`` is not called, as a wrapper's may set the attribute of the wrapped object instead. Random
    generators and running statistics of the object are updated in place, so that other objects continue to share them.

    :param obj: the object to change
    :param state: the plain data of each attribute, by name
    :raises ValueError: if the plain data represents an unknown type
    """
    attributes = vars(obj)
    for name, plain in state.items():
        attributes[name] = from_plain(plain, attributes.get(name))


def to_plain(value: Any) -> Any:
    """
    Copy a value as plain data.

    Plain data is ``None``, bool, int, float, str, bytes, numeric NumPy arrays and scalars, and lists, tuples and
    dictionaries with string keys that contain only plain data. Dictionaries with other keys, OrderedDicts, Counters,
    defaultdicts of builtin types, deques, sets, NumPy's random generators, and the running statistics of SB3 and Gymnasium are
    represented as dictionaries that name the type. Subclasses of these types are refused, as they may hold further state. Two
    references to one object become two copies. The state from which a generator would ``spawn`` others is not copied.

    :param value: the value
    :return: the plain data, which shares no mutable object with the value
    :raises NotPlainError: if the value, or a part of it, is of another type
    """
    kind = type(value)
    if kind in SCALARS or (isinstance(value, np.generic) and value.dtype.kind in NUMERIC):
        return value
    if kind is np.ndarray and value.dtype.kind in NUMERIC:
        # The memory layout determines the order in which NumPy adds numbers
        return value.copy(order="K")
    if kind in (list, tuple):
        return kind([to_plain(each) for each in value])
    if kind is dict and TYPE not in value and all(type(key) is str for key in value):
        return {key: to_plain(each) for key, each in value.items()}
    if kind in MAPPINGS.values():
        return {TYPE: kind.__name__, "items": [(to_plain(key), to_plain(each)) for key, each in value.items()]}
    if kind is defaultdict and value.default_factory in FACTORIES.values():
        return {TYPE: kind.__name__, "factory": value.default_factory.__name__, "items": to_plain(dict(value))}
    if kind in COLLECTIONS.values():
        plain = {TYPE: kind.__name__, "items": [to_plain(each) for each in value]}
        return plain | ({"maxlen": value.maxlen} if kind is deque else {})
    if kind is np.random.Generator and type(value.bit_generator) in BIT_GENERATORS.values():
        return {TYPE: kind.__name__, "state": to_plain(value.bit_generator.state)}
    for name, statistics in STATISTICS.items():
        if kind is statistics:
            return {TYPE: name, "attributes": to_plain(vars(value))}
    raise NotPlainError(f"A {kind.__module__}.{kind.__qualname__} is not plain data.")


def declared_state(described: str, own: Any) -> Any:
    """
    Copy the state that an object declares, by a method such as ``get_training_state``, as plain data.

    :param described: the method, for the error
    :param own: what it returned
    :return: the plain data
    :raises ValueError: if it is anything else, naming the method and what it returned
    """
    try:
        return to_plain(own)
    except NotPlainError as error:
        raise ValueError(f"{described} returned {own!r}, but must return plain data: {error}") from error


def from_plain(plain: Any, current: Any = None) -> Any:
    """
    Convert plain data back to the value that :func:`to_plain` copied.

    :param plain: the plain data
    :param current: the value that is about to be replaced, or None. Its random generators and running statistics, also
        those within its lists, tuples and dictionaries, are updated in place and become part of the returned value.
    :return: the value, which shares no mutable object with the plain data
    :raises ValueError: if the plain data represents an unknown type
    """
    if type(plain) is np.ndarray:
        return plain.copy(order="K")
    if type(plain) in (list, tuple):
        return type(plain)([from_plain(each, _part(current, index)) for index, each in enumerate(plain)])
    if type(plain) is not dict:
        return plain
    name = plain.get(TYPE)
    if name is None:
        return {key: from_plain(each, _part(current, key)) for key, each in plain.items()}
    if name in MAPPINGS:
        pairs = [(from_plain(key), each) for key, each in plain["items"]]
        return MAPPINGS[name]({key: from_plain(each, _part(current, key)) for key, each in pairs})
    if name == defaultdict.__name__:
        return defaultdict(FACTORIES[plain["factory"]], from_plain(plain["items"], current))
    if name in COLLECTIONS:
        items = [from_plain(each) for each in plain["items"]]
        return deque(items, plain["maxlen"]) if name == deque.__name__ else COLLECTIONS[name](items)
    if name == np.random.Generator.__name__:
        return _generator(from_plain(plain["state"]), current)
    known = (*MAPPINGS, "defaultdict", *COLLECTIONS, "Generator", *STATISTICS)
    require(name in STATISTICS, TYPE, name, f"one of {', '.join(known)}")
    statistics = current if type(current) is STATISTICS[name] else STATISTICS[name]()
    set_plain_attributes(statistics, plain["attributes"])
    return statistics


def equal(plain: Any, other: Any) -> bool:
    """
    Return whether two values are the same as plain data.

    :param plain: plain data
    :param other: other plain data
    :return: whether both are of the same type and have equal elements; NaN equals NaN
    """
    if type(plain) is not type(other):
        return False
    if isinstance(plain, np.ndarray):
        return plain.dtype == other.dtype and np.array_equal(plain, other, equal_nan=plain.dtype.kind in "fc")
    if isinstance(plain, dict):
        # Each process has an order of its own for strings
        if plain.get(TYPE) == other.get(TYPE) in UNORDERED and from_plain(plain) == from_plain(other):
            return True
        return plain.keys() == other.keys() and all(equal(value, other[key]) for key, value in plain.items())
    if isinstance(plain, list | tuple):
        return len(plain) == len(other) and all(map(equal, plain, other))
    return bool(plain == other or (plain != plain and other != other))


def _part(current: Any, key: Any) -> Any:
    """Return the element of a list, tuple or dictionary at an index or key, or None if there is no such element."""
    if isinstance(current, list | tuple):
        return current[key] if key < len(current) else None
    return current.get(key) if isinstance(current, dict) else None


def _generator(state: dict[str, Any], current: Any) -> np.random.Generator:
    """Set the state of the current random generator, or of a new one if the current one is of another kind."""
    kind = state["bit_generator"]
    require(kind in BIT_GENERATORS, "bit_generator", kind, f"one of {', '.join(BIT_GENERATORS)}")
    fits = type(current) is np.random.Generator and type(current.bit_generator) is BIT_GENERATORS[kind]
    generator = current if fits else np.random.Generator(BIT_GENERATORS[kind]())
    generator.bit_generator.state = state
    return generator
