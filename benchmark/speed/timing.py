"""Timing several things in turn, so that a drift of the machine's speed hits all of them alike."""

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
    Time one call, with all the work that it leaves to the device.

    :param run: what to time
    :param device: where it computes
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
    Time callables in turn: once each per round, every round beginning with the next one.

    :param callables: what to time, by name
    :param rounds: how often to time each
    :param burn_in: untimed rounds before the first timed one
    :param device: where they compute
    :param title: named beside a bar of the progress; without it, no bar
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
    Summarise measurements of one thing.

    :param values: the measurements
    :return: their median, lower and upper quartile, and all of them
    """
    lower, median, upper = np.percentile(values, [25, 50, 75])
    return {"median": float(median), "lower": float(lower), "upper": float(upper), "all": list(values)}


def ratio(seconds: Sequence[float], reference: Sequence[float]) -> float:
    """
    Compare two things timed in turn: the median of the rounds' ratios, from which a slow round drops out.

    :param seconds: one thing's times, by round
    :param reference: the other's
    :return: the median ratio
    """
    return float(np.median(np.divide(seconds, reference)))
