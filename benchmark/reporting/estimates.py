"""Estimates with intervals, by rliable's bootstrap or Student's t: every statistic of the results page."""

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from rliable.library import StratifiedIndependentBootstrap
from scipy import stats

from benchmark.reporting.copies import without_copies

# Of draws of runs at once: a call of SciPy for each would take most of the time
Statistic = Callable[..., np.ndarray]
# The runs of each configuration, by a key that is the same for copies of them
Cells = Mapping[Hashable, np.ndarray]

REPETITIONS = 2_000
# Fewer runs on either side of a comparison decide nothing: even if no run of three overlaps with the other three, chance alone
# separates them in one case of ten; four and four in one of 35
FEWEST_RUNS = 4


@dataclass(frozen=True)
class Estimate:
    """
    A number that is estimated from runs.

    :param value: the estimate
    :param interval: its 95 % interval; None where there are too few runs for one
    :param runs: how many runs the smallest of the compared groups has
    """

    value: float
    interval: tuple[float, float] | None
    runs: int

    def negative(self) -> "Estimate":
        """
        Return the estimate of the opposite number, such as a loss in place of a gain.

        :return: the estimate
        """
        return Estimate(-self.value, None if self.interval is None else (-self.interval[1], -self.interval[0]), self.runs)

    def in_words(self, form: str = ".2f") -> str:
        """
        Return the number and its interval as text.

        :param form: the numbers' format
        :return: such as "0.52 (0.40 to 0.61)"
        """
        if self.interval is None:
            return f"{self.value:{form}} (no interval)"
        low, high = self.interval
        return f"{self.value:{form}} ({low:{form}} to {high:{form}})"


def bootstrap(statistic: Statistic, groups: Sequence[Cells], repetitions: int) -> tuple[np.ndarray, np.ndarray | None]:
    """
    Estimate a statistic of groups of runs, drawing runs within each cell (a task and a configuration), not across cells. A
    cell that several groups have is drawn once for all of them.

    :param statistic: takes an array per group, (R, N, ...), of R draws of its N runs in any order, and returns (R, ...)
    :param groups: each group's cells, of shape (runs, ...)
    :param repetitions: number of bootstrap samples, R
    :return: the statistic (...), and its 95 % interval (2, ...); None where a cell has fewer than
        :data:`FEWEST_RUNS` runs, of which a bootstrap interval is far too narrow
    """
    value = statistic(*(np.concatenate(list(cells.values()))[None] for cells in groups))[0]
    if any(len(cell) < FEWEST_RUNS for cells in groups for cell in cells.values()):
        return value, None
    # rliable draws within columns: cells of one size are the columns of one array
    arrays: list[np.ndarray] = []
    places: dict[Hashable, tuple[int, int]] = {}
    for cells in groups:
        for size in sorted({len(cell) for cell in cells.values()}):
            new = [key for key, cell in cells.items() if len(cell) == size and key not in places]
            if new:
                places |= {key: (len(arrays), column) for column, key in enumerate(new)}
                arrays.append(np.stack([cells[key] for key in new], axis=1))
    # rliable ignores its random_state and draws from NumPy's global generator
    state = np.random.get_state()  # noqa: NPY002
    np.random.seed(0)  # noqa: NPY002
    try:
        draws = [drawn for drawn, _ in StratifiedIndependentBootstrap(*arrays).bootstrap(repetitions)]
    finally:
        np.random.set_state(state)  # noqa: NPY002
    drawn = [np.stack(each) for each in zip(*draws, strict=True)]
    pooled = (
        np.concatenate([drawn[array][:, :, column] for array, column in map(places.__getitem__, cells)], axis=1)
        for cells in groups
    )
    return value, np.percentile(statistic(*pooled), [2.5, 97.5], axis=0)


def estimate(statistic: Statistic, groups: Sequence[Cells], repetitions: int) -> Estimate:
    """
    Estimate one number, as :func:`bootstrap` does.

    :param statistic: takes an array per group, (R, N), and returns the number of each draw (R)
    :param groups: each group's cells
    :param repetitions: number of bootstrap samples
    :return: the estimate
    """
    value, interval = bootstrap(statistic, groups, repetitions)
    runs = min(sum(map(len, cells.values())) for cells in groups)
    return Estimate(float(value), None if interval is None else (float(interval[0]), float(interval[1])), runs)


def cells_of(table: pd.DataFrame, column: str) -> dict[Hashable, np.ndarray]:
    """
    Split runs of one method into cells, without copies.

    :param table: the runs' scores
    :param column: the column wanted
    :return: an array of each cell's runs, by what they were trained with and their values
    """
    ordered = without_copies(table).sort_values("cell", kind="stable")
    cells = {name: cell.to_numpy(dtype=float) for name, cell in ordered.groupby("trained", sort=False)[column]}
    # The scores of copies that other machines trained differ, so that they are drawn by themselves
    return {(name, *cell): cell for name, cell in cells.items()}


def in_common(table: pd.DataFrame, methods: Sequence[str]) -> pd.DataFrame:
    """
    Keep the runs of methods in the cells that all of them have.

    :param table: the runs' scores
    :param methods: the methods
    :return: their runs there; none if one method has no cell with the others
    """
    chosen = table[table["method"].isin(methods)]
    return chosen[chosen.groupby("cell")["method"].transform("nunique") == len(methods)]


def compare(
    table: pd.DataFrame, methods: Sequence[str], statistic: Statistic, column: str = "share", repetitions: int = REPETITIONS
) -> Estimate | None:
    """
    Compare methods on the tasks and configurations that all of them ran.

    :param table: the runs' scores
    :param methods: the methods
    :param statistic: takes an array per method, (R, N), of a task's runs, and returns numbers (R), whose mean over tasks is
        estimated
    :param column: which scores it takes
    :param repetitions: number of bootstrap samples
    :return: the estimate; None if the methods have no configuration in common
    """
    common = in_common(table, methods)
    tasks = list(dict.fromkeys(common["task"]))
    if not tasks:
        return None
    groups = []
    for task in tasks:
        runs = common[common["task"] == task]
        groups += [cells_of(runs[runs["method"] == method], column) for method in methods]

    def mean_over_tasks(*pooled: np.ndarray) -> np.ndarray:
        width = len(methods)
        return np.mean([statistic(*pooled[start : start + width]) for start in range(0, len(pooled), width)], axis=0)

    return estimate(mean_over_tasks, groups, repetitions)


def mean_of_differences(pairs: Sequence[tuple[np.ndarray, np.ndarray]]) -> Estimate:
    """
    Estimate the mean over tasks of the difference between two means, with the t interval of Welch and Satterthwaite, which is
    right for few runs and unequal variances.

    :param pairs: for each task, our runs (N) and their runs (M)
    :return: our mean less theirs, averaged over tasks; without an interval where one side has one run only
    """
    groups = [runs for pair in pairs for runs in pair]
    value, fewest = float(np.mean([ours.mean() - theirs.mean() for ours, theirs in pairs])), min(map(len, groups))
    if fewest < 2:
        return Estimate(value, None, fewest)
    variances = np.array([runs.var(ddof=1) / len(runs) for runs in groups]) / len(pairs) ** 2
    total = float(variances.sum())
    if total == 0:
        # Without any variance, the degrees of freedom are no number
        return Estimate(value, (value, value), fewest)
    freedom = total**2 / np.sum(variances**2 / [len(runs) - 1 for runs in groups])
    half = float(stats.t.ppf(0.975, freedom)) * math.sqrt(total)
    return Estimate(value, (value - half, value + half), fewest)


def number_format(scores: pd.Series) -> str:
    """
    Return the format of numbers of the size of a task's rewards.

    :param scores: the rewards
    :return: the format with about three significant digits of their range
    """
    width = float(scores.max() - scores.min())
    return f".{max(0, 3 - math.floor(math.log10(width))) if width > 0 else 1}f"


def interquartile_mean(scores: np.ndarray) -> np.ndarray:
    """
    Average the middle half, as rliable does.

    :param scores: runs (R, N, ...)
    :return: the mean without the lowest and the highest quarter (R, ...)
    """
    return stats.trim_mean(scores, 0.25, axis=1)


def share_reaching(scores: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """
    Return the share of runs that reach each level: the stability curve, a performance profile.

    :param scores: runs (R, N)
    :param levels: the levels (K)
    :return: the share that scores at least so much (R, K)
    """
    below = [np.searchsorted(each, levels) for each in np.sort(scores, axis=1)]
    return 1 - np.array(below) / scores.shape[1]


def probability_of_improvement(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """
    Estimate how often a run of ours scores more than one of theirs, as rliable does: by the Mann-Whitney statistic.

    :param ours: our runs (R, N)
    :param theirs: their runs (R, M)
    :return: the probability, ties counted as half (R)
    """
    # The statistic does not depend on the method, which is that of the p-value
    wins = stats.mannwhitneyu(ours, theirs, axis=1, method="asymptotic").statistic
    return wins / (ours.shape[1] * theirs.shape[1])


def interquartile_mean_difference(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """
    Compare interquartile means.

    :param ours: our runs (R, N)
    :param theirs: their runs (R, M)
    :return: ours less theirs (R)
    """
    return interquartile_mean(ours) - interquartile_mean(theirs)


def interquartile_range(scores: np.ndarray) -> np.ndarray:
    """
    Return the interquartile range.

    :param scores: runs (R, N)
    :return: the upper quartile less the lower one (R)
    """
    return stats.iqr(scores, axis=1)
