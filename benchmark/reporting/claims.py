"""The paper's claims, each tested on the runs of the studies."""

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np
import pandas as pd

from benchmark.reporting.comparisons import RANDOM, task_difference
from benchmark.reporting.copies import without_copies
from benchmark.reporting.estimates import (
    FEWEST_RUNS,
    Estimate,
    Statistic,
    compare,
    estimate,
    in_common,
    interquartile_mean,
    interquartile_mean_difference,
    interquartile_range,
)
from benchmark.reporting.failures import FAILURE, HIGH_LEARNING_RATE, few_steps_fail, has_high_rate, high_rate_fails
from benchmark.reporting.verdicts import CONTRADICTED, MARGIN, NOT_DECIDED, OURS, SUPPORTED, TOO_FEW, Finding, Part, judge

FAMILY = ("CGP-Online", "CGP-Offline", "QGP-Online", "QGP-Offline")
IMITATED = "CEM"
# The beginnings of the names of CGP's variants, which are no rivals of it
VARIANTS = ("CGP", "QGP")
BASELINES = ("TD3", "SAC", "DDPG")
# Of the actor's inference time, with more CEM iterations to that with fewer
COST_MARGIN = 0.1

RULES = f"""\
Returns are compared as shares of their task's range, from 0 for the lowest return of any evaluation to 1 for the best final
reward, and averaged over tasks, without those on which all returns are the same; a task at two numbers of steps counts as two
tasks. Configurations with more runs weigh more. Methods are compared on the configurations that all of them ran. A claim is
*{SUPPORTED}* or *{CONTRADICTED}* if the whole 95 % interval lies on its side or on the other, *{NOT_DECIDED}* if not, or if a
method or a configuration has fewer than {FEWEST_RUNS} runs; of several parts, all must be supported, and one is enough to
contradict. The intervals are those of *How to read this page*, which few seeds make too narrow. The interquartile range, which
measures what the paper calls spread, is that of final returns over all configurations and seeds: it is 0 for a method that
always fails, too, so read it with the stability curve. *At least as good* and *equal* allow {MARGIN:g} of the range, so that a
variant is *lower* than others by more than this; *independent* allows {COST_MARGIN:.0%}. *Fails* means that the mean loses
{FAILURE:g} of the range against the best of the other values, chosen by these data, where all else is equal. "Best or second
best" is among {OURS} and all methods but its variants, {IMITATED} and {RANDOM}, in studies that vary no hyperparameter, on
each task by itself: *{SUPPORTED}* if {OURS} is higher than all rivals but one, *{CONTRADICTED}* if it is lower than two, by
the intervals of the tables of differences; a task with fewer than {FEWEST_RUNS} runs of one of them has *{TOO_FEW}*. Only
this project's experiments count, as their files' names say, and E10 does not, as its tasks are not the paper's."""


def findings(table: pd.DataFrame, runtime: dict[str, Any] | None, repetitions: int) -> list[Finding]:
    """
    Test all claims.

    :param table: the scores of all runs
    :param runtime: the record of ``benchmark.runtime``; None without one
    :param repetitions: number of bootstrap samples
    :return: a finding per claim
    """
    # Where all returns are the same, nothing has been learnt, and all methods are equal
    table = table[table.groupby("task")["share"].transform("max") > 0]
    swept = table[table["settings"] != ""]
    return [
        Finding("best or second best on every task", best_or_second(table[table["settings"] == ""])),
        Finding(
            f"narrower interquartile range over hyperparameters and seeds than {', '.join(BASELINES)}",
            narrower(swept, repetitions),
        ),
        Finding("the actor is at least as good as the CEM policy that it imitates", imitation(table, repetitions)),
        Finding("the actor's inference cost is independent of the CEM iterations", inference_cost(runtime, repetitions)),
        Finding(f"a learning rate of {HIGH_LEARNING_RATE:g} fails", high_rate_fails(swept, repetitions)),
        Finding("few initial random steps fail", few_steps_fail(swept, repetitions)),
        Finding(
            f"three of the four variants are equal in the upper quartiles, and {FAMILY[3]} is lower",
            equal_variants(swept, repetitions),
        ),
        Finding(f"{OURS} is the best variant in the bottom quartile", best_at_the_bottom(swept, repetitions)),
        Finding("online training is mildly better than offline training", online_better(table, repetitions)),
    ]


def best_or_second(table: pd.DataFrame) -> list[Part]:
    """
    Test whether at most one rival is better: by the differences from all rivals.

    :param table: the scores of runs that vary no hyperparameter
    :return: a part for each task of each study that has two rivals, those with too few runs last
    """
    parts = []
    for _, runs in table.groupby("cell", sort=False):
        rivals = sorted(method for method in set(runs["method"]) - {IMITATED, RANDOM} if not method.startswith(VARIANTS))
        if OURS in set(runs["method"]) and len(rivals) >= 2:
            parts.append(_rank(runs, rivals))
    return sorted(parts, key=lambda part: part.verdict == TOO_FEW)


def _rank(runs: pd.DataFrame, rivals: Sequence[str]) -> Part:
    """Compare CGP with its rivals on a task."""
    task, methods = runs["task"].iloc[0], (OURS, *rivals)
    numbers = {method: int((runs["method"] == method).sum()) for method in methods}
    if min(numbers.values()) < FEWEST_RUNS:
        ended = ", ".join(f"{number} of {method}" for method, number in numbers.items())
        return Part(f"{task}, of which only {ended} have ended", TOO_FEW)
    leads = [task_difference(runs, task, (OURS, rival), "share") for rival in rivals]
    verdicts = [NOT_DECIDED if lead is None else judge(lead, more_than=0) for lead in leads]
    means = _each(runs, methods, lambda scores: scores.mean(axis=1))
    rank = 1 + sum(mean > means[0] for mean in means[1:])
    higher, lower = verdicts.count(SUPPORTED), verdicts.count(CONTRADICTED)
    verdict = SUPPORTED if higher >= len(rivals) - 1 else CONTRADICTED if lower >= 2 else NOT_DECIDED
    counted = f"higher than {higher} and lower than {lower} of {len(rivals)} rivals"
    decided = counted if higher or lower else f"not distinguishable from any of {len(rivals)} rivals"
    return Part(f"rank {rank} of {len(means)} on {task}, {decided}", verdict)


def narrower(table: pd.DataFrame, repetitions: int) -> list[Part]:
    """
    Test whether the interquartile range of CGP's rewards is smaller than each baseline's, without the high learning rates,
    which the paper leaves out, too.

    :param table: the scores of runs that vary hyperparameters
    :param repetitions: number of bootstrap samples
    :return: a comparison per baseline
    """
    usual = table[~has_high_rate(table)]
    parts = []
    for baseline in BASELINES:
        pair = (OURS, baseline)
        found = compare(
            usual, pair, lambda ours, theirs: interquartile_range(theirs) - interquartile_range(ours), repetitions=repetitions
        )
        if found is not None:
            ours, theirs = _each(usual, pair, interquartile_range)
            difference = _signed(found, "narrower", "wider", ".4f")
            text = f"range {ours:.4f} against {baseline}'s {theirs:.4f}: {difference}"
            note = ""
            if len(in_common(usual, pair)) < len(in_common(table, pair)):
                ours, theirs = _each(table, pair, interquartile_range)
                note = f"learning rates from {HIGH_LEARNING_RATE:g} on included, {ours:.4f} against {theirs:.4f}"
            parts.append(Part(text, judge(found, more_than=0), note))
    return parts


def imitation(table: pd.DataFrame, repetitions: int) -> list[Part]:
    """
    Test whether CGP's actor scores as much as CEM itself.

    :param table: the scores of all runs
    :param repetitions: number of bootstrap samples
    :return: the comparison, if both were run
    """
    found = compare(table, (OURS, IMITATED), interquartile_mean_difference, repetitions=repetitions)
    if found is None:
        return []
    text = _in_words("interquartile mean", table, (OURS, IMITATED), interquartile_mean, found)
    return [Part(text, judge(found, more_than=-MARGIN), _margin_in_words(table, (OURS, IMITATED)))]


def inference_cost(runtime: dict[str, Any] | None, repetitions: int) -> list[Part]:
    """
    Test whether acting takes as long after training with many CEM iterations as with few.

    :param runtime: the record of ``benchmark.runtime``; None without one
    :param repetitions: number of bootstrap samples of the rounds
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
    # The methods are timed in turn, so that a slow round affects both
    found = estimate(lambda ratios: np.median(ratios, axis=1), [{"": ours[many] / ours[few]}], repetitions)
    text = f"by `benchmark.runtime`, acting after {many} iterations takes {found.in_words()} times as long as after {few}"
    cem = seconds("CEM-")
    note = f"CEM itself {np.median(cem[many] / cem[few]):.2f} times" if {few, many} <= set(cem) else ""
    return [Part(text, judge(found, more_than=1 - COST_MARGIN, less_than=1 + COST_MARGIN), note)]


def equal_variants(table: pd.DataFrame, repetitions: int) -> list[Part]:
    """
    Test whether the better halves of the variants' runs are equal, all but QGP-Offline's, which is lower.

    :param table: the scores of runs that vary hyperparameters
    :param repetitions: number of bootstrap samples
    :return: a comparison for each pair of the three variants, and of each of them with the fourth, if all four were run
    """

    def better_half(scores: np.ndarray) -> np.ndarray:
        return np.sort(scores, axis=1)[:, scores.shape[1] // 2 :].mean(axis=1)

    *three, fourth = FAMILY
    equal = _differences(
        table, list(combinations(three, 2)), "better half", better_half, repetitions, more_than=-MARGIN, less_than=MARGIN
    )
    # A fourth that is equal, too, contradicts "three of the four"
    lower = [(each, fourth) for each in three]
    return equal + _differences(table, lower, "better half", better_half, repetitions, more_than=MARGIN)


def best_at_the_bottom(table: pd.DataFrame, repetitions: int) -> list[Part]:
    """
    Test whether the lowest quarter of CGP-Online's runs is better than the other variants'.

    :param table: the scores of runs that vary hyperparameters
    :param repetitions: number of bootstrap samples
    :return: a comparison with each other variant, if all four were run
    """

    def lowest_quarter(scores: np.ndarray) -> np.ndarray:
        return np.sort(scores, axis=1)[:, : -(-scores.shape[1] // 4)].mean(axis=1)

    pairs = [(OURS, other) for other in FAMILY if other != OURS]
    return _differences(table, pairs, "lowest quarter", lowest_quarter, repetitions, more_than=0.0)


def _differences(
    table: pd.DataFrame, pairs: Sequence[tuple[str, str]], name: str, statistic: Statistic, repetitions: int, **bounds: float
) -> list[Part]:
    """
    Compare a statistic of pairs of variants, where all variants were run.

    Each pair is a comparison of its own, as the bootstrap of a maximum over methods, or of their range, is biased.
    """
    common, parts = in_common(table, FAMILY), []
    for pair in pairs:
        found = compare(common, pair, lambda ours, theirs: statistic(ours) - statistic(theirs), repetitions=repetitions)
        if found is not None:
            text = _in_words(name, common, pair, statistic, found)
            note = _margin_in_words(common, pair) if MARGIN in map(abs, bounds.values()) else ""
            parts.append(Part(text, judge(found, **bounds), note))
    return parts


def _in_words(name: str, table: pd.DataFrame, pair: tuple[str, str], statistic: Statistic, found: Estimate) -> str:
    ours, theirs = _each(table, pair, statistic)
    return f"{name} of {pair[0]} {ours:.3f}, of {pair[1]} {theirs:.3f}: {_signed(found, 'higher', 'lower')}"


def _margin_in_words(table: pd.DataFrame, pair: tuple[str, str]) -> str:
    """Return the margin of a verdict in returns, on each task that is compared."""
    ranges = in_common(table, pair).groupby("task", sort=False)["range"].first()
    margins = [f"{MARGIN * width:,.{0 if MARGIN * width >= 100 else 2}f} on {task}" for task, width in ranges.items()]
    return f"{MARGIN:g} of the range is {'; '.join(margins)}"


def _signed(found: Estimate, more: str, less: str, form: str = ".3f") -> str:
    """Return a difference as text, such as "higher by 0.05 (0.01 to 0.09)", or "lower by" the opposite number."""
    word, size = (more, found) if found.value >= 0 else (less, found.negative())
    return f"{word} by {size.in_words(form)}"


def online_better(table: pd.DataFrame, repetitions: int) -> list[Part]:
    """
    Test whether training the policy online gives more than training it offline.

    :param table: the scores of all runs
    :param repetitions: number of bootstrap samples
    :return: a comparison for CGP and one for QGP
    """
    parts = []
    for kind in ("CGP", "QGP"):
        pair = (f"{kind}-Online", f"{kind}-Offline")
        found = compare(table, pair, interquartile_mean_difference, repetitions=repetitions)
        if found is not None:
            text = _in_words("interquartile mean", table, pair, interquartile_mean, found)
            parts.append(Part(text, judge(found, more_than=0)))
    return parts


def _each(table: pd.DataFrame, methods: Sequence[str], statistic: Statistic) -> list[float]:
    """Compute a statistic of each method where :func:`compare` compares them."""
    common = in_common(table, methods)

    def mean_over_tasks(runs: pd.DataFrame) -> float:
        return float(np.mean([statistic(shares.to_numpy()[None])[0] for _, shares in runs.groupby("task")["share"]]))

    return [mean_over_tasks(without_copies(common[common["method"] == method])) for method in methods]
