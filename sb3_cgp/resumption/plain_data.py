"""Objects' attributes as plain data, which a checkpoint can hold without pickle, and back."""

from collections import OrderedDict, deque
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
from gymnasium.wrappers.utils import RunningMeanStd as GymnasiumRunningMeanStd
from stable_baselines3.common.running_mean_std import RunningMeanStd

from sb3_cgp.common.rules import require

# Marks a dictionary that stands for something else, and says for what
TYPE = "__type__"
SCALARS = (type(None), bool, int, float, str, bytes)
# The kinds of NumPy's types: booleans, and numbers
NUMERIC = "biufc"
COLLECTIONS: dict[str, Any] = {kind.__name__: kind for kind in (deque, set, frozenset)}
MAPPINGS: dict[str, Any] = {kind.__name__: kind for kind in (dict, OrderedDict)}
STATISTICS: dict[str, Any] = {
    "stable_baselines3.RunningMeanStd": RunningMeanStd,
    "gymnasium.RunningMeanStd": GymnasiumRunningMeanStd,
}
BIT_GENERATORS: dict[str, Any] = {
    kind.__name__: kind
    for kind in (np.random.MT19937, np.random.PCG64, np.random.PCG64DXSM, np.random.Philox, np.random.SFC64)
}


class NotPlainError(TypeError):
    """A value is no plain data, nor anything that is known to be made of it."""


def plain_attributes(obj: Any, without: Collection[str] = ()) -> dict[str, Any]:
    """
    Copy those attributes of an object that are plain data, see :func:`to_plain`, and leave out the others.

    :param obj: the object
    :param without: the names of attributes to leave out
    :return: the attributes' values by name
    """
    state = {}
    for name, value in vars(obj).items():
        if name not in without:
            try:
                state[name] = to_plain(value)
            except (NotPlainError, RecursionError):
                # The latter is a list that holds itself
                continue
    return state


def set_plain_attributes(obj: Any, state: Mapping[str, Any]) -> None:
    """
    Put back what :func:`plain_attributes` copied. What ``state`` does not name stays as it is.

    It goes to the object itself, past any ``__setattr__`` that hands values on, as wrappers have. Random generators and
    running statistics are set in place where the object has them, so that whoever shares them still does.

    :param obj: the object
    :param state: the attributes' values by name
    :raises ValueError: if a value stands for something unknown
    """
    attributes = vars(obj)
    for name, plain in state.items():
        attributes[name] = from_plain(plain, attributes.get(name))


def to_plain(value: Any) -> Any:
    """
    Copy a value as plain data: ``None``, bool, int, float, str, bytes, NumPy's numeric arrays and scalars, and lists,
    tuples and dictionaries (of strings as keys) of such.

    Other dictionaries, ordered ones, deques, sets, NumPy's random generators and running statistics (SB3's and
    Gymnasium's) become dictionaries that say what they stand for. Neither the sharing of one object in several places nor
    what a generator would ``spawn`` is kept. Subclasses of all these are refused, as they may hold more.

    :param value: the value
    :return: the plain data, which shares nothing that could change with the value
    :raises NotPlainError: if the value is anything else, or holds it
    """
    kind = type(value)
    if kind in SCALARS or (isinstance(value, np.generic) and value.dtype.kind in NUMERIC):
        return value
    if kind is np.ndarray and value.dtype.kind in NUMERIC:
        # The layout decides in which order sums are taken
        return value.copy(order="K")
    if kind in (list, tuple):
        return kind([to_plain(each) for each in value])
    if kind is dict and TYPE not in value and all(type(key) is str for key in value):
        return {key: to_plain(each) for key, each in value.items()}
    if kind in MAPPINGS.values():
        return {TYPE: kind.__name__, "items": [(to_plain(key), to_plain(each)) for key, each in value.items()]}
    if kind in COLLECTIONS.values():
        plain = {TYPE: kind.__name__, "items": [to_plain(each) for each in value]}
        return plain | ({"maxlen": value.maxlen} if kind is deque else {})
    if kind is np.random.Generator and type(value.bit_generator) in BIT_GENERATORS.values():
        return {TYPE: kind.__name__, "state": to_plain(value.bit_generator.state)}
    for name, statistics in STATISTICS.items():
        if kind is statistics:
            return {TYPE: name, "attributes": to_plain(vars(value))}
    raise NotPlainError(f"A {kind.__module__}.{kind.__qualname__} is no plain data.")


def from_plain(plain: Any, there: Any = None) -> Any:
    """
    Make the value that :func:`to_plain` copied.

    :param plain: the plain data
    :param there: what the value is to take the place of, if anything; random generators and running statistics in it, or
        within lists, tuples and dictionaries of it, are set in place and used again
    :return: the value, which shares nothing that could change with the plain data
    :raises ValueError: if the plain data stands for something unknown
    """
    if type(plain) is np.ndarray:
        return plain.copy(order="K")
    if type(plain) in (list, tuple):
        return type(plain)([from_plain(each, _part(there, index)) for index, each in enumerate(plain)])
    if type(plain) is not dict:
        return plain
    name = plain.get(TYPE)
    if name is None:
        return {key: from_plain(each, _part(there, key)) for key, each in plain.items()}
    if name in MAPPINGS:
        pairs = [(from_plain(key), each) for key, each in plain["items"]]
        return MAPPINGS[name]((key, from_plain(each, _part(there, key))) for key, each in pairs)
    if name in COLLECTIONS:
        items = [from_plain(each) for each in plain["items"]]
        return deque(items, plain["maxlen"]) if name == deque.__name__ else COLLECTIONS[name](items)
    if name == np.random.Generator.__name__:
        return _generator(from_plain(plain["state"]), there)
    require(name in STATISTICS, TYPE, name, f"one of {', '.join((*MAPPINGS, *COLLECTIONS, 'Generator', *STATISTICS))}")
    statistics = there if type(there) is STATISTICS[name] else STATISTICS[name]()
    set_plain_attributes(statistics, plain["attributes"])
    return statistics


def _part(there: Any, key: Any) -> Any:
    """Find what a part of a value takes the place of."""
    if isinstance(there, list | tuple):
        return there[key] if key < len(there) else None
    return there.get(key) if isinstance(there, dict) else None


def _generator(state: dict[str, Any], there: Any) -> np.random.Generator:
    """Set a random generator's state, in place if it is of the same kind."""
    kind = state["bit_generator"]
    require(kind in BIT_GENERATORS, "bit_generator", kind, f"one of {', '.join(BIT_GENERATORS)}")
    fits = type(there) is np.random.Generator and type(there.bit_generator) is BIT_GENERATORS[kind]
    generator = there if fits else np.random.Generator(BIT_GENERATORS[kind]())
    generator.bit_generator.state = state
    return generator
