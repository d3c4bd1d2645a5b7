"""Comparisons between the methods of a study without axes: differences of means, and probabilities of improvement."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations, product

import numpy as np
import pandas as pd

from benchmark.common.tables import markdown_table
from benchmark.reporting.copies import without_copies
from benchmark.reporting.estimates import (
    FEWEST_RUNS,
    Estimate,
    compare,
    in_common,
    mean_of_differences,
    number_format,
    probability_of_improvement,
)
from benchmark.reporting.scores import Study, by_family, score_table
from benchmark.reporting.verdicts import LIGHT, OURS, TOO_FEW

RANDOM = "Random"
HEADER = ["task", "difference", "of means (95 % interval)", "the first is", "runs"]
HIGHER, LOWER, NOT_DISTINGUISHABLE = "higher", "lower", "not distinguishable"
DIFFERENCES_RULE = f"""\
In tables of differences, each row has the first method's mean final return less the second's. The intervals of single tasks
are Welch's t intervals: with 4 runs each, these contain the true difference in 96 % of the cases on normally distributed
returns, and in 95 % where one standard deviation is three times the other; a percentile bootstrap does in 84 %. Where a
quarter of the runs collapses by 10 standard deviations, they contain it in 98 % of the cases if runs of both methods do, but
in 74 % if those of one method alone do, of whose 4 runs none collapses in a third of the cases. The rows on all tasks have
means over the tasks with {FEWEST_RUNS} or more runs of both methods, each with the same weight, and twice if it was run with
two numbers of steps, of returns as shares of each task's range, from 0 for the lowest return of any evaluation to 1 for the
best final return, with the same t intervals (96 % of the cases with 4 runs on each of 5 tasks).
*{NOT_DISTINGUISHABLE.capitalize()}* means that the interval contains 0, which is no proof that the methods are equal; with
fewer than {FEWEST_RUNS} runs of a method, nothing is concluded. One in twenty intervals misses the true difference by chance,
and no correction is made for their number."""


def difference_in_words(found: Estimate) -> str:
    """
    Return what an interval says about a difference.

    :param found: the difference
    :return: "higher" or "lower" if the whole interval is above or below 0
    """
    if found.interval is None or found.runs < FEWEST_RUNS:
        return TOO_FEW
    low, high = found.interval
    return HIGHER if low > 0 else LOWER if high < 0 else NOT_DISTINGUISHABLE


def subjects_of(methods: Sequence[str]) -> list[str]:
    """
    List the methods that are compared with each other method of a study.

    :param methods: the methods of the study, in order
    :return: the light setting and the paper's method; the first method that learns in a study of neither
    """
    learners = [method for method in methods if method != RANDOM]
    return [method for method in (LIGHT, OURS) if method in learners] or learners[:1]


def pairs_of(methods: Sequence[str]) -> list[tuple[str, str]]:
    """
    List the pairs whose differences are of interest: those of :func:`subjects_of` with each other method.

    :param methods: the methods of a study, in order
    :return: the pairs, each once, the light setting's first; none with random actions
    """
    subjects = subjects_of(methods)
    others = [method for method in methods if method not in (*subjects, RANDOM)]
    return [*combinations(subjects, 2), *product(subjects, others)]


def task_difference(table: pd.DataFrame, task: str, pair: tuple[str, str], column: str = "score") -> Estimate | None:
    """
    Estimate the difference between two methods on a task.

    :param table: the scores of a study without axes
    :param task: the task
    :param pair: the methods
    :param column: which scores are compared
    :return: the first method's mean less the second's; None if one of them has no run
    """
    ours, theirs = _runs_of(table, task, pair, column)
    return mean_of_differences([(ours, theirs)]) if len(ours) > 0 and len(theirs) > 0 else None


def _runs_of(table: pd.DataFrame, task: str, pair: tuple[str, str], column: str) -> tuple[np.ndarray, np.ndarray]:
    runs = table[table["task"] == task]
    ours, theirs = (runs[runs["method"] == method][column].to_numpy(dtype=float) for method in pair)
    return ours, theirs


def differences_table(table: pd.DataFrame, methods: Sequence[str]) -> str:
    """
    Tabulate differences between methods, on each task and on all tasks together.

    :param table: the scores of a study without axes
    :param methods: the methods, in order
    :return: the table, in Markdown; empty if no two methods are compared
    """
    tasks = list(dict.fromkeys(table["task"]))
    rows = []
    for task in tasks:
        form = number_format(table[table["task"] == task]["score"])
        for pair in pairs_of(methods):
            found = task_difference(table, task, pair)
            if found is not None:
                rows.append(_row(task, pair, found, form, table[table["task"] == task]))
    rows += pooled_rows(table, methods)
    return markdown_table(HEADER, rows) if rows else ""


def pooled_rows(table: pd.DataFrame, methods: Sequence[str]) -> list[list[str]]:
    """
    Return the rows of a table of differences that are on all tasks together, or on those with enough runs of both methods.

    :param table: the scores of runs without axes, of one study or of several
    :param methods: the methods, in order
    :return: the rows; none for pairs that fewer than two tasks have enough runs of
    """
    tasks, rows = list(dict.fromkeys(table["task"])), []
    for pair in pairs_of(methods):
        common = without_copies(in_common(table, pair))
        singles = {task: task_difference(common, task, pair) for task in tasks}
        enough = [task for task, found in singles.items() if found is not None and found.runs >= FEWEST_RUNS]
        if len(enough) > 1:
            scope = f"all tasks ({len(tasks)})" if enough == tasks else ", ".join(enough)
            pooled = mean_of_differences([_runs_of(common, task, pair, "share") for task in enough])
            rows.append(_row(scope, pair, pooled, ".3f", common[common["task"].isin(enough)]))
    return rows


def experiments_section(studies: Sequence[Study]) -> str:
    """
    Compare methods on all tasks of an experiment whose tasks are studies of their own.

    :param studies: the studies, without those of shorter trial runs
    :return: the section, in Markdown; empty if no experiment without axes has several studies with enough runs
    """
    parts = []
    for family, members in by_family(study for study in studies if not study.axes).items():
        methods = list(dict.fromkeys(method for study in members for method in study.methods))
        rows = pooled_rows(score_table(members), methods) if len(members) > 1 else []
        if rows:
            names = ", ".join(study.name for study in members if _is_compared(study))
            parts += [f"{family}, the studies {names}:", markdown_table(HEADER, rows)]
    return "\n\n".join(["## Differences on all tasks of an experiment", *parts]) if parts else ""


def _is_compared(study: Study) -> bool:
    """Return whether a task of a study has enough runs of two methods."""
    numbers = Counter((record.task, record.method) for record in study.records)
    tasks = Counter(task for (task, _), number in numbers.items() if number >= FEWEST_RUNS)
    return max(tasks.values(), default=0) > 1


def _row(task: str, pair: tuple[str, str], found: Estimate, form: str, runs: pd.DataFrame) -> list[str]:
    ours, theirs = (_seeds(runs, method) for method in pair)
    return [task, " − ".join(pair), found.in_words(form), difference_in_words(found), f"{ours} and {theirs}"]


def _seeds(runs: pd.DataFrame, method: str) -> int:
    return int((runs["method"] == method).sum())


def improvement_table(table: pd.DataFrame, subject: str, methods: Sequence[str], repetitions: int) -> str:
    """
    Tabulate the probability that a method improves on each other method.

    :param table: the runs' scores
    :param subject: the method
    :param methods: all methods, in the rows' order
    :param repetitions: number of bootstrap samples
    :return: the table, in Markdown; empty without runs of the method or of others
    """
    tasks = list(dict.fromkeys(table["task"]))
    rows = []
    for method in methods:
        scopes = [table[table["task"] == task] for task in tasks] + [table] * (len(tasks) > 1)
        found = [
            # Each configuration by itself: a run is compared with runs of the same configuration only
            (
                compare(scope.assign(task=scope["cell"]), (subject, method), probability_of_improvement, "score", repetitions)
                if method != subject
                else None
            )
            for scope in scopes
        ]
        if any(found):
            rows.append([method, *(_cell(each) for each in found)])
    if not rows:
        return ""
    header = [f"{subject} against", *tasks, *["all tasks"] * (len(tasks) > 1)]
    note = (
        f"The probability that a random run of {subject} has a higher final return than one of the other method with the same "
        "configuration; a tie counts one half (95 % interval). There is no interval where a configuration has fewer than "
        f"{FEWEST_RUNS} runs of a method, or where no draw of the runs changes the number, as where all runs of one "
        "method are above all of the other's: by chance in one case of 35 with 4 runs each. No conclusion rests on this table."
    )
    return f"{markdown_table(header, rows)}\n\n{note}"


def _cell(found: Estimate | None) -> str:
    if found is None:
        return "-"
    is_constant = found.interval is not None and found.interval[0] == found.interval[1]
    return (replace(found, interval=None) if is_constant else found).in_words()
