"""Timing of several functions in turn, so that a drift of the machine's speed affects all of them alike."""

import time
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
import torch as th
from tqdm import tqdm

Key = TypeVar("Key", bound=Hashable)
CPU = th.device("cpu")


def timed(run: Callable[[], object], device: th.device = CPU) -> float:
    """
    Time one call, with all its work on the device.

    :param run: the function to time
    :param device: the device that it computes on
    :return: seconds
    """
    _synchronise(device)
    start = time.perf_counter()
    run()
    _synchronise(device)
    return time.perf_counter() - start


def _synchronise(device: th.device) -> None:
    if device.type == "cuda":
        th.cuda.synchronize(device)


def interleaved(
    callables: Mapping[Key, Callable[[], object]], rounds: int, burn_in: int = 1, device: th.device = CPU, title: str = ""
) -> dict[Key, list[float]]:
    """
    Time functions in turn: each once per round, where each round begins with the next function.

    :param callables: the functions to time, by name
    :param rounds: number of timed rounds
    :param burn_in: untimed rounds before the first timed one
    :param device: the device that they compute on
    :param title: title of the progress bar; empty for no bar
    :return: seconds of each call, by name, in the order of the rounds
    """
    names = list(callables)
    seconds: dict[Key, list[float]] = {name: [] for name in names}
    for turn in tqdm(range(burn_in + rounds), desc=title, unit="round", disable=not title):
        first = turn % max(len(names), 1)
        for name in names[first:] + names[:first]:
            duration = timed(callables[name], device)
            if turn >= burn_in:
                seconds[name].append(duration)
    return seconds


def summary(values: Sequence[float]) -> dict[str, Any]:
    """
    Summarise measurements.

    :param values: the measurements
    :return: their median, lower and upper quartile, and all of them
    """
    lower, median, upper = np.percentile(values, [25, 50, 75])
    return {"median": float(median), "lower": float(lower), "upper": float(upper), "all": list(values)}


def ratio(seconds: Sequence[float], reference: Sequence[float]) -> float:
    """
    Compare two functions that were timed in turn: the median of the rounds' ratios is robust to slow rounds.

    :param seconds: the times of the one, by round
    :param reference: the times of the other, by round
    :return: the median ratio
    """
    return float(np.median(np.divide(seconds, reference)))
