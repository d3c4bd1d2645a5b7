"""How often 95 % intervals contain the truth, as the page of results says, by simulations that use none of its code."""

import re
from collections.abc import Callable

import numpy as np
import pytest
from scipy import stats

from benchmark.reporting.comparisons import DIFFERENCES_RULE
from benchmark.reporting.page import READING

# Data sets, and bootstrap samples of each: the shares below are exact to a percent or two
SETS, DRAWS = 2_000, 500


def words(text: str) -> str:
    return " ".join(text.split())


def share(low: np.ndarray, high: np.ndarray, truth: float) -> float:
    return 100 * float(np.mean((low <= truth) & (truth <= high)))


def percentile_interval(statistic: Callable[[np.ndarray], np.ndarray], draws: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the bootstrap interval of each data set, from its draws (sets, draws, runs)."""
    low, high = np.percentile(statistic(draws), [2.5, 97.5], axis=1)
    return low, high


def drawn(rng: np.random.Generator, runs: np.ndarray) -> np.ndarray:
    """Draw from each data set (sets, runs) with replacement: (sets, draws, runs)."""
    picked = rng.integers(0, runs.shape[1], (len(runs), DRAWS, runs.shape[1]))
    return np.take_along_axis(np.broadcast_to(runs[:, None], picked.shape), picked, axis=2)


def test_interquartile_means() -> None:
    found = re.search(r"interquartile mean of ([\d, ]+) runs contains the true value in ([\d, ]+) %", words(READING))
    assert found is not None
    numbers, stated = ([int(number) for number in each.split(", ")] for each in found.groups())
    rng = np.random.default_rng(0)
    for number, expected in zip(numbers, stated, strict=True):
        draws = drawn(rng, rng.normal(size=(SETS, number)))
        interval = percentile_interval(lambda runs: stats.trim_mean(runs, 0.25, axis=2), draws)
        assert share(*interval, 0.0) == pytest.approx(expected, abs=2.5), number


@pytest.mark.parametrize("configurations", [3, 10])
def test_interquartile_means_over_configurations(configurations: int) -> None:
    sentence = r"Over several configurations with 4 runs of each the interval contains the true value in (\d+) %"
    stated = re.search(sentence, words(READING))
    assert stated is not None
    rng = np.random.default_rng(3)
    # Each configuration's runs are drawn by themselves
    draws = np.concatenate([drawn(rng, rng.normal(size=(SETS, 4))) for _ in range(configurations)], axis=2)
    interval = percentile_interval(lambda runs: stats.trim_mean(runs, 0.25, axis=2), draws)
    assert share(*interval, 0.0) == pytest.approx(int(stated[1]), abs=2.5)


def test_differences_of_four_runs_each() -> None:
    rng, rule = np.random.default_rng(1), words(DIFFERENCES_RULE)

    def welch(ours: np.ndarray, theirs: np.ndarray, truth: float) -> float:
        interval = stats.ttest_ind(ours, theirs, axis=1, equal_var=False).confidence_interval()
        return share(interval.low, interval.high, truth)

    def normal() -> np.ndarray:
        return rng.normal(size=(10 * SETS, 4))

    def collapsing() -> np.ndarray:
        return normal() - 10 * (rng.random((10 * SETS, 4)) < 0.25)

    def stated(pattern: str) -> object:
        found = re.search(pattern, rule)
        assert found is not None, pattern
        return pytest.approx(int(found[1]), abs=1.0)

    assert welch(normal(), normal(), 0.0) == stated(r"in (\d+) % of the cases on normally distributed")
    assert welch(normal(), 3 * normal(), 0.0) == stated(r"in (\d+) % where one standard deviation is three times")
    assert welch(collapsing(), collapsing(), 0.0) == stated(r"in (\d+) % of the cases if runs of both methods do")
    assert welch(collapsing(), normal(), -2.5) == stated(r"in (\d+) % if those of one method alone do")
    assert abs(100 * 0.75**4 - 100 / 3) < 2
    assert "none collapses in a third of the cases" in rule


def test_bootstrap_of_differences() -> None:
    rng, rule = np.random.default_rng(2), words(DIFFERENCES_RULE)
    ours, theirs = (drawn(rng, rng.normal(size=(SETS, 4))).mean(axis=2) for _ in range(2))
    stated = re.search(r"a percentile bootstrap does in (\d+) %", rule)
    assert stated is not None
    low, high = np.percentile(ours - theirs, [2.5, 97.5], axis=1)
    assert share(low, high, 0.0) == pytest.approx(int(stated[1]), abs=2.5)


@pytest.mark.parametrize("scale", [1.0, 3.0])
def test_differences_over_tasks(scale: float) -> None:
    stated = re.search(
        r"the same t intervals \((\d+) % of the cases with 4 runs on each of 5 tasks\)", words(DIFFERENCES_RULE)
    )
    assert stated is not None
    rng = np.random.default_rng(4)
    # By method, one of which has the larger standard deviation: (2, sets, tasks, runs)
    runs = rng.normal(size=(2, 10 * SETS, 5, 4)) * np.array([1.0, scale])[:, None, None, None]
    difference = (runs[0].mean(axis=2) - runs[1].mean(axis=2)).mean(axis=1)
    variances = runs.var(axis=3, ddof=1) / 4 / 5**2
    total = variances.sum(axis=(0, 2))
    half = stats.t.ppf(0.975, total**2 / (variances**2 / 3).sum(axis=(0, 2))) * np.sqrt(total)
    assert share(difference - half, difference + half, 0.0) == pytest.approx(int(stated[1]), abs=1.0)
