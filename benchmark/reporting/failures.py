"""The paper's claims of failure: values of a hyperparameter with which CGP loses much of the reward."""

import numpy as np
import pandas as pd

from benchmark.reporting.estimates import Cells, cells_of, estimate
from benchmark.reporting.verdicts import OURS, Part, judge

LEARNING_RATE, INITIAL_STEPS = "learning_rate", "learning_starts"
# The paper leaves such rates out where it speaks of all hyperparameters
HIGH_LEARNING_RATE = 1e-2
# The loss of reward that counts as a failure, as a share of the task's range
FAILURE = 0.25


def high_rate_fails(table: pd.DataFrame, repetitions: int) -> list[Part]:
    """
    Test whether CGP fails with a high learning rate.

    :param table: the scores of runs that vary hyperparameters
    :param repetitions: number of bootstrap samples
    :return: the comparison with the best of the other rates, if both were run
    """
    varied = table[_has(table, LEARNING_RATE)]
    return _fails(varied, LEARNING_RATE, has_high_rate(varied), repetitions)


def few_steps_fail(table: pd.DataFrame, repetitions: int) -> list[Part]:
    """
    Test whether CGP fails with fewer initial random steps than the most that were tried.

    :param table: the scores of runs that vary hyperparameters
    :param repetitions: number of bootstrap samples
    :return: the comparison with the most, if several were tried
    """
    varied = table[_has(table, INITIAL_STEPS)]
    given = pd.Series([values[INITIAL_STEPS] for values in varied["values"]], varied.index, dtype=object)
    # A named value of a user's axis is no number
    steps = pd.to_numeric(given, errors="coerce")
    most = steps.groupby(varied["study"]).transform("max")
    return _fails(varied, INITIAL_STEPS, steps < most, repetitions)


def _has(table: pd.DataFrame, axis: str) -> pd.Series:
    return pd.Series([axis in values for values in table["values"]], table.index, dtype=bool)


def has_high_rate(table: pd.DataFrame) -> pd.Series:
    """
    Return which runs have a high learning rate.

    :param table: the scores of runs
    :return: a boolean for each run; False for a schedule
    """
    rates = pd.Series([values.get(LEARNING_RATE) for values in table["values"]], table.index, dtype=object)
    return pd.to_numeric(rates, errors="coerce") >= HIGH_LEARNING_RATE


def _fails(table: pd.DataFrame, axis: str, is_bad: pd.Series, repetitions: int) -> list[Part]:
    """Compare CGP's mean rewards between an axis's bad values and the best other one, in each task of each study."""
    ours = table.assign(
        value=[str(values[axis]) for values in table["values"]],
        rest=[str({name: value for name, value in values.items() if name != axis}) for values in table["values"]],
        is_bad=is_bad,
    )[table["method"] == OURS]
    groups: list[Cells] = []
    bad_values: list[str] = []
    good_values: list[str] = []
    for _, runs in ours.groupby(["study", "task"], sort=False):
        bad, others = runs[runs["is_bad"]], runs[~runs["is_bad"]]
        pairs = []
        for _, good in others.groupby("value", sort=False):
            # Where all else is equal
            both = set(bad["rest"]) & set(good["rest"])
            if both:
                pairs.append((good[good["rest"].isin(both)], bad[bad["rest"].isin(both)]))
        if pairs:
            good, poor = max(pairs, key=lambda pair: pair[0]["share"].mean())
            groups += [cells_of(good, "share"), cells_of(poor, "share")]
            good_values += map(str, good["value"])
            bad_values += map(str, poor["value"])
    if not groups:
        return []

    def lost(*pooled: np.ndarray) -> np.ndarray:
        pairs = zip(pooled[::2], pooled[1::2], strict=True)
        return np.mean([good.mean(axis=1) - poor.mean(axis=1) for good, poor in pairs], axis=0)

    found = estimate(lost, groups, repetitions)
    pooled = [np.concatenate(list(group.values())) for group in groups]
    means = [float(np.mean([np.mean(scores) for scores in pooled[start::2]])) for start in (1, 0)]
    halved = sum(np.sum(poor < 0.5 * np.mean(good)) for good, poor in zip(pooled[::2], pooled[1::2], strict=True))
    names = [" or ".join(dict.fromkeys(values)) for values in (bad_values, good_values)]
    text = (
        f"mean {means[0]:.3f} with {names[0]}, {means[1]:.3f} with {names[1]}: {found.in_words('.3f')} lost; "
        f"{halved} of {sum(map(len, pooled[1::2]))} runs below half of the latter"
    )
    return [Part(text, judge(found, more_than=FAILURE))]
