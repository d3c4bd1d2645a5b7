"""Mistakes in hyperparameters that can be named before a model is constructed."""

import difflib
import inspect
from collections.abc import Iterator
from typing import Any

import yaml
from rl_zoo3 import ALGOS

from benchmark.sweeps.random_actions import NAME as RANDOM

# Keys of an entry that rl_zoo3 reads itself, beside the algorithm's arguments, without the steps
ZOO_HYPERPARAMS = ("frame_stack", "n_envs", "noise_std", "noise_type", "normalize", "policy_kwargs")
# Further ones, which hold the arguments of other code, in which text may look like a number
FOREIGN_ARGUMENTS = ("callback", "env_kwargs", "env_wrapper", "monitor_kwargs", "vec_env_wrapper")
# The hyperparameters that rl_zoo3 takes as text, too: "lin_0.001" is a schedule
SCHEDULES = ("learning_rate", "clip_range", "clip_range_vf", "delta_std")


def problems(method: str, algo: str, hyperparams: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """
    List the mistakes in hyperparameters: names that the algorithm does not have, and text in the place of numbers.

    :param method: the method's name
    :param algo: the algorithm's name in rl_zoo3
    :param hyperparams: the hyperparameters
    :return: the key of each mistake, and what is wrong with it
    """
    parameters = inspect.signature(ALGOS[algo]).parameters
    allowed = {*parameters, *ZOO_HYPERPARAMS, *FOREIGN_ARGUMENTS} - {"env", "seed", "device", "verbose"}
    for name, value in hyperparams.items():
        if name not in allowed and algo != RANDOM:
            close = ", ".join(difflib.get_close_matches(name, allowed, n=3) or sorted(allowed))
            yield name, f"no hyperparameter of {method} ({algo}), which must be one of {close}"
        for text in () if name in FOREIGN_ARGUMENTS else _numbers_as_text(value):
            number = text if text.isdecimal() else yaml.safe_dump(float(text)).splitlines()[0]
            yield name, f"{text!r} of {method} ({algo}) is text in YAML, and must be a number: write {number}"
        default = parameters[name].default if name in parameters else None
        is_number = isinstance(default, int | float) and not isinstance(default, bool)
        if isinstance(value, str) and is_number and name not in SCHEDULES:
            yield name, f"{value!r} of {method} ({algo}) must be a number, such as the default, {default!r}"
        if isinstance(value, str) and name in SCHEDULES and not value.startswith("lin_"):
            # rl_zoo3 ignores the word
            yield name, f"{value!r} of {method} ({algo}) must be a number, or a linear schedule, such as lin_0.001"


def _numbers_as_text(value: Any) -> Iterator[str]:
    """List the texts that Python reads as numbers, also within lists and mappings."""
    if isinstance(value, dict | list | tuple):
        for each in value.values() if isinstance(value, dict) else value:
            yield from _numbers_as_text(each)
    elif isinstance(value, str):
        try:
            float(value)
        except ValueError:
            return
        yield value
