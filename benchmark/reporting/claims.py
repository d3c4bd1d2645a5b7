"""The paper's claims, each tested on the runs at hand: what they say, and how surely."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from benchmark.reporting.estimates import (
    FEWEST_RUNS,
    REPETITIONS,
    Estimate,
    Statistic,
    cells_of,
    compare,
    difference,
    estimate,
    in_common,
    interquartile_mean,
    spread,
)

SUPPORTED, CONTRADICTED = "supported", "contradicted"
NOT_DECIDED, NO_DATA = "not decided by these data", "no data"

OURS, RANDOM = "CGP-Online", "Random"
FAMILY = ("CGP-Online", "CGP-Offline", "QGP-Online", "QGP-Offline")
IMITATED = "CEM"
BASELINES = ("TD3", "SAC", "DDPG")
LEARNING_RATE, INITIAL_STEPS = "learning_rate", "learning_starts"
# The paper leaves such rates out where it speaks of all hyperparameters
HIGH_LEARNING_RATE = 1e-2
# In shares of a task's range: what counts as no difference, and what as a failure
MARGIN, FAILURE = 0.05, 0.25
# Of the actor's inference time, with more CEM iterations to that with fewer
COST_MARGIN = 0.1

RULES = f"""\
Rewards are compared as shares of their task's range, from 0 for the lowest return of any evaluation to 1 for the best final
reward, and averaged over tasks. Methods are compared on the configurations that all of them ran. A claim is *{SUPPORTED}*
or *{CONTRADICTED}* if the whole 95 % interval lies on its side or on the other, *{NOT_DECIDED}* if not, or if a method has
fewer than {FEWEST_RUNS} runs or a configuration only one; of several parts, all must be supported, and one is enough to
contradict. *Spread* is the interquartile range of final rewards over all configurations and seeds: a method that fails
everywhere has none, too, so read it with the stability curve. *At least as good* and *equal* allow {MARGIN:g} of the range,
*independent* allows {COST_MARGIN:.0%}. *Fails* means that the mean loses {FAILURE:g} of the range against the best of the
other values, chosen by these data, where all else is equal. "Best or second best" is among {OURS} and all methods but its
variants, {IMITATED} and {RANDOM}, in studies that vary no hyperparameter, on each task by itself."""


@dataclass(frozen=True)
class Part:
    """
    One comparison that a claim rests on.

    :param text: what was compared, and what came out
    :param verdict: what that says of the claim
    """

    text: str
    verdict: str


@dataclass(frozen=True)
class Finding:
    """
    What the runs say of a claim.

    :param claim: the paper's claim
    :param parts: the comparisons that it rests on; none without data
    """

    claim: str
    parts: list[Part]

    @property
    def verdict(self) -> str:
        """What all parts together say."""
        verdicts = [part.verdict for part in self.parts]
        if not verdicts:
            return NO_DATA
        if CONTRADICTED in verdicts:
            return CONTRADICTED
        return SUPPORTED if set(verdicts) == {SUPPORTED} else NOT_DECIDED

    @property
    def text(self) -> str:
        """What all parts say, each with its verdict if there are several."""
        if len(self.parts) == 1:
            return self.parts[0].text
        return "; ".join(f"{part.text}: {part.verdict}" for part in self.parts)


def judge(found: Estimate, more_than: float = -np.inf, less_than: float = np.inf) -> str:
    """
    Compare an interval with what a claim needs.

    :param found: the estimate
    :param more_than: what it must be above
    :param less_than: what it must be below
    :return: the verdict
    """
    if found.interval is None or found.runs < FEWEST_RUNS:
        return NOT_DECIDED
    low, high = found.interval
    if low > more_than and high < less_than:
        return SUPPORTED
    return CONTRADICTED if high < more_than or low > less_than else NOT_DECIDED


def findings(table: pd.DataFrame, runtime: dict[str, Any] | None, repetitions: int = REPETITIONS) -> list[Finding]:
    """
    Test all claims.

    :param table: the scores of all runs
    :param runtime: what ``benchmark.runtime`` measured, if it did
    :param repetitions: how often the bootstrap draws runs
    :return: a finding per claim
    """
    swept = table[table["settings"] != ""]
    return [
        Finding("best or second best on every task", best_or_second(table[table["settings"] == ""], repetitions)),
        Finding(f"narrower spread over hyperparameters and seeds than {', '.join(BASELINES)}", narrower(swept, repetitions)),
        Finding("the actor is at least as good as the CEM policy that it imitates", imitation(table, repetitions)),
        Finding("the actor's inference cost is independent of the CEM iterations", inference_cost(runtime, repetitions)),
        Finding(f"a learning rate of {HIGH_LEARNING_RATE:g} fails", high_rate_fails(swept, repetitions)),
        Finding("few initial random steps fail", few_steps_fail(swept, repetitions)),
        Finding("three of the four variants are equal in the upper quartiles", equal_variants(swept, repetitions)),
        Finding(f"{OURS} is the best variant in the bottom quartile", best_at_the_bottom(swept, repetitions)),
        Finding("online training is mildly better than offline training", online_better(table, repetitions)),
    ]


def best_or_second(table: pd.DataFrame, repetitions: int) -> list[Part]:
    """
    Test whether at most one rival is better: by the lead over the second best rival.

    :param table: the scores of runs that vary no hyperparameter
    :param repetitions: how often the bootstrap draws runs
    :return: a comparison for each task of each study that has two rivals
    """

    def lead(ours: np.ndarray, *theirs: np.ndarray) -> np.ndarray:
        return interquartile_mean(ours) - np.sort([interquartile_mean(each) for each in theirs], axis=0)[-2]

    parts = []
    for _, runs in table.groupby("cell", sort=False):
        rivals = sorted(set(runs["method"]) - {*FAMILY, IMITATED, RANDOM})
        if OURS in set(runs["method"]) and len(rivals) >= 2:
            found = compare(runs, (OURS, *rivals), lead, repetitions=repetitions)
            assert found is not None
            means = _each(runs, (OURS, *rivals), interquartile_mean)
            rank = 1 + sum(mean > means[0] for mean in means[1:])
            place = f"rank {rank} of {len(means)} on {runs['task'].iloc[0]}"
            text = f"{place}, lead over the second best rival {found.in_words('.3f')}"
            parts.append(Part(text, judge(found, more_than=0)))
    return parts


def narrower(table: pd.DataFrame, repetitions: int) -> list[Part]:
    """
    Test whether CGP's rewards scatter less than each baseline's, leaving out the high learning rates, as the paper does.

    :param table: the scores of runs that vary hyperparameters
    :param repetitions: how often the bootstrap draws runs
    :return: a comparison per baseline
    """
    usual = table[~_has_high_rate(table)]
    parts = []
    for baseline in BASELINES:
        pair = (OURS, baseline)
        found = compare(usual, pair, lambda ours, theirs: spread(theirs) - spread(ours), repetitions=repetitions)
        if found is not None:
            ours, theirs = _each(usual, pair, spread)
            text = f"{ours:.3f} against {baseline}'s {theirs:.3f}, less by {found.in_words('.3f')}"
            if len(in_common(usual, pair)) < len(in_common(table, pair)):
                ours, theirs = _each(table, pair, spread)
                text += f" (learning rates from {HIGH_LEARNING_RATE:g} on included, {ours:.3f} against {theirs:.3f})"
            parts.append(Part(text, judge(found, more_than=0)))
    return parts


def imitation(table: pd.DataFrame, repetitions: int) -> list[Part]:
    """
    Test whether CGP's actor scores as much as CEM itself.

    :param table: the scores of all runs
    :param repetitions: how often the bootstrap draws runs
    :return: the comparison, if both were run
    """
    found = compare(table, (OURS, IMITATED), difference, repetitions=repetitions)
    if found is None:
        return []
    ours, theirs = _each(table, (OURS, IMITATED), interquartile_mean)
    text = f"{ours:.2f} against {IMITATED}'s {theirs:.2f}, more by {found.in_words('.3f')}"
    return [Part(text, judge(found, more_than=-MARGIN))]


def inference_cost(runtime: dict[str, Any] | None, repetitions: int) -> list[Part]:
    """
    Test whether acting takes as long after training with many CEM iterations as with few.

    :param runtime: what ``benchmark.runtime`` measured, if it did
    :param repetitions: how often the bootstrap draws rounds
    :return: the comparison, if two numbers of iterations were timed
    """
    methods = {} if runtime is None else runtime["methods"]

    def seconds(prefix: str) -> dict[int, np.ndarray]:
        timed = {
            name.removeprefix(prefix): method.get("inference") for name, method in methods.items() if name.startswith(prefix)
        }
        return {int(name): np.array(time["seconds"]["all"]) for name, time in timed.items() if name.isdecimal() and time}

    ours = seconds("CGP-")
    if len(ours) < 2:
        return []
    few, many = min(ours), max(ours)
    # The methods take turns: what slows a round down slows down both
    found = estimate(lambda ratios: np.median(ratios, axis=1), [[ours[many] / ours[few]]], repetitions)
    text = f"by `benchmark.runtime`, acting after {many} iterations takes {found.in_words()} times as long as after {few}"
    cem = seconds("CEM-")
    if {few, many} <= set(cem):
        text += f" (CEM itself {np.median(cem[many] / cem[few]):.2f} times)"
    return [Part(text, judge(found, more_than=1 - COST_MARGIN, less_than=1 + COST_MARGIN))]


def high_rate_fails(table: pd.DataFrame, repetitions: int) -> list[Part]:
    """
    Test whether CGP fails with a high learning rate.

    :param table: the scores of runs that vary hyperparameters
    :param repetitions: how often the bootstrap draws runs
    :return: the comparison with the best of the other rates, if both were run
    """
    varied = table[_has(table, LEARNING_RATE)]
    return _fails(varied, LEARNING_RATE, _has_high_rate(varied), repetitions)


def few_steps_fail(table: pd.DataFrame, repetitions: int) -> list[Part]:
    """
    Test whether CGP fails with fewer initial random steps than the most that were tried.

    :param table: the scores of runs that vary hyperparameters
    :param repetitions: how often the bootstrap draws runs
    :return: the comparison with the most, if several were tried
    """
    varied = table[_has(table, INITIAL_STEPS)]
    steps = pd.Series([values[INITIAL_STEPS] for values in varied["values"]], varied.index, dtype=float)
    most = steps.groupby(varied["study"]).transform("max")
    return _fails(varied, INITIAL_STEPS, steps < most, repetitions)


def equal_variants(table: pd.DataFrame, repetitions: int) -> list[Part]:
    """
    Test whether the better halves of the variants' runs are equal, all but QGP-Offline's.

    :param table: the scores of runs that vary hyperparameters
    :param repetitions: how often the bootstrap draws runs
    :return: the comparison, if all four were run
    """

    def better_half(scores: np.ndarray) -> np.ndarray:
        return np.sort(scores, axis=1)[:, scores.shape[1] // 2 :].mean(axis=1)

    def largest_gap(*scores: np.ndarray) -> np.ndarray:
        return np.ptp([better_half(each) for each in scores[:3]], axis=0)

    found = compare(table, FAMILY, largest_gap, repetitions=repetitions)
    if found is None:
        return []
    text = f"better halves: {_listed(table, better_half)}; largest gap among the first three {found.in_words('.3f')}"
    return [Part(text, judge(found, less_than=MARGIN))]


def best_at_the_bottom(table: pd.DataFrame, repetitions: int) -> list[Part]:
    """
    Test whether the lowest quarter of CGP-Online's runs is better than the other variants'.

    :param table: the scores of runs that vary hyperparameters
    :param repetitions: how often the bootstrap draws runs
    :return: the comparison, if all four were run
    """

    def lowest_quarter(scores: np.ndarray) -> np.ndarray:
        return np.sort(scores, axis=1)[:, : -(-scores.shape[1] // 4)].mean(axis=1)

    def lead(ours: np.ndarray, *theirs: np.ndarray) -> np.ndarray:
        return lowest_quarter(ours) - np.max([lowest_quarter(each) for each in theirs], axis=0)

    found = compare(table, FAMILY, lead, repetitions=repetitions)
    if found is None:
        return []
    text = f"lowest quarters: {_listed(table, lowest_quarter)}; lead over the best other {found.in_words('.3f')}"
    return [Part(text, judge(found, more_than=0))]


def online_better(table: pd.DataFrame, repetitions: int) -> list[Part]:
    """
    Test whether training the policy online gives more than training it offline.

    :param table: the scores of all runs
    :param repetitions: how often the bootstrap draws runs
    :return: a comparison for CGP and one for QGP
    """
    parts = []
    for kind in ("CGP", "QGP"):
        found = compare(table, (f"{kind}-Online", f"{kind}-Offline"), difference, repetitions=repetitions)
        if found is not None:
            parts.append(Part(f"{kind}: more by {found.in_words('.3f')}", judge(found, more_than=0)))
    return parts


def _has(table: pd.DataFrame, axis: str) -> pd.Series:
    return pd.Series([axis in values for values in table["values"]], table.index, dtype=bool)


def _has_high_rate(table: pd.DataFrame) -> pd.Series:
    """Tell which runs have a high learning rate; a schedule's name is none."""
    rates = pd.Series([values.get(LEARNING_RATE) for values in table["values"]], table.index, dtype=object)
    return pd.to_numeric(rates, errors="coerce") >= HIGH_LEARNING_RATE


def _each(table: pd.DataFrame, methods: Sequence[str], statistic: Statistic) -> list[float]:
    """Compute a statistic of each method where :func:`compare` compares them."""
    common = in_common(table, methods)

    def mean_over_tasks(runs: pd.DataFrame) -> float:
        return float(np.mean([statistic(shares.to_numpy()[None])[0] for _, shares in runs.groupby("task")["share"]]))

    return [mean_over_tasks(common[common["method"] == method]) for method in methods]


def _listed(table: pd.DataFrame, statistic: Statistic) -> str:
    values = _each(table, FAMILY, statistic)
    return ", ".join(f"{method} {value:.2f}" for method, value in zip(FAMILY, values, strict=True))


def _fails(table: pd.DataFrame, axis: str, is_bad: pd.Series, repetitions: int) -> list[Part]:
    """Compare CGP's mean rewards between an axis's bad values and the best other one, in each task of each study."""
    ours = table.assign(
        value=[str(values[axis]) for values in table["values"]],
        rest=[str({name: value for name, value in values.items() if name != axis}) for values in table["values"]],
        is_bad=is_bad,
    )[table["method"] == OURS]
    groups: list[list[np.ndarray]] = []
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
    pooled = [np.concatenate(group) for group in groups]
    means = [float(np.mean([np.mean(scores) for scores in pooled[start::2]])) for start in (1, 0)]
    halved = sum(np.sum(poor < 0.5 * np.mean(good)) for good, poor in zip(pooled[::2], pooled[1::2], strict=True))
    names = [" or ".join(dict.fromkeys(values)) for values in (bad_values, good_values)]
    text = (
        f"mean {means[0]:.2f} with {names[0]}, {means[1]:.2f} with {names[1]}: {found.in_words()} lost; "
        f"{halved} of {sum(map(len, pooled[1::2]))} runs below half of the latter"
    )
    return [Part(text, judge(found, more_than=FAILURE))]
