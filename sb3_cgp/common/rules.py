"""Rules on arguments, and the errors for arguments that break them."""

import difflib
import math
from collections.abc import Iterable, Mapping
from numbers import Integral, Real
from typing import Any


def require(condition: bool, name: str, value: Any, allowed: str) -> None:
    """
    Refuse an argument that breaks a rule.

    :param condition: whether the rule holds
    :param name: the argument's name
    :param value: the argument's value
    :param allowed: what is allowed, completing "must be ..."
    :raises ValueError: if the rule does not hold
    """
    if not condition:
        raise ValueError(f"The value of `{name}` is {value!r}, but must be {allowed}.")


def nearest(name: str, choices: Iterable[str], cutoff: float = 0.6) -> str | None:
    """
    Return the choice that is most similar to a misspelt name.

    :param name: the misspelt name
    :param choices: the names that are allowed
    :param cutoff: the smallest similarity, within [0, 1]
    :return: the most similar name; None if no name is similar
    """
    return next(iter(difflib.get_close_matches(name, sorted(choices), n=1, cutoff=cutoff)), None)


def unknown_argument(
    called: str,
    name: str,
    value: Any,
    choices: Iterable[str],
    remedies: Mapping[str, str] | None = None,
    usage: str | None = None,
    cutoff: float = 0.6,
) -> TypeError:
    """
    Return the error for a keyword argument that does not exist.

    :param called: what was called, such as ``CGP.learn``
    :param name: the argument's name
    :param value: the argument's value
    :param choices: the names that are allowed
    :param remedies: sentences for names that are known to be given here by mistake
    :param usage: a sentence where no name is similar; None for one that lists the choices
    :param cutoff: the smallest similarity of the nearest name, within [0, 1]
    :return: the error
    """
    choices = sorted(choices)
    similar = nearest(name, choices, cutoff)
    if remedies is not None and name in remedies:
        remedy = remedies[name]
    elif similar is not None:
        remedy = f"Did you mean `{similar}`?"
    else:
        remedy = f"It takes {', '.join(choices)}." if usage is None else usage
    return TypeError(f"The value of `{name}` is {value!r}, but `{called}` takes no such argument. {remedy}")


def require_count(name: str, value: Any, minimum: int = 1) -> None:
    """
    Refuse anything but an integer of at least ``minimum``.

    :param name: the argument's name
    :param value: the argument's value
    :param minimum: the smallest value that is allowed
    :raises ValueError: if the value is not such an integer
    """
    is_integer = isinstance(value, Integral) and not isinstance(value, bool)
    require(is_integer and value >= minimum, name, value, f"an integer >= {minimum}")


def as_count(name: str, value: Any, advice: str = "") -> int:
    """
    Return a count of at least 0 as an integer, also of an equal float such as 1e5, as SB3 takes some.

    :param name: the argument's name
    :param value: the argument's value
    :param advice: what the error adds to the rule
    :return: the integer
    :raises ValueError: if the value is no integer of at least 0, nor a float equal to one
    """
    number = float(value) if isinstance(value, Real) and not isinstance(value, bool) else math.nan
    require(number >= 0 and number % 1 == 0, name, value, f"an integer >= 0{advice}")
    return int(value)


def require_number(name: str, value: Any, low: float = 0.0, high: float = math.inf) -> None:
    """
    Refuse anything but a finite number within ``[low, high]``.

    :param name: the argument's name
    :param value: the argument's value
    :param low: the smallest value that is allowed
    :param high: the largest value that is allowed
    :raises ValueError: if the value is not such a number
    """
    is_number = isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
    allowed = f"a finite number >= {low:g}" if math.isinf(high) else f"a number within [{low:g}, {high:g}]"
    require(is_number and low <= value <= high, name, value, allowed)


def require_choice(name: str, value: Any, choices: Iterable[Any]) -> None:
    """
    Refuse anything that is not among ``choices``.

    :param name: the argument's name
    :param value: the argument's value
    :param choices: the values that are allowed
    :raises ValueError: if the value is not one of them
    """
    choices = list(choices)
    require(value in choices, name, value, "one of " + ", ".join(repr(choice) for choice in choices))
