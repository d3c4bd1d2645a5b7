"""What each study found on each task, in a line: the table that a page of a user's own sweeps begins with."""

from collections.abc import Sequence
from dataclasses import dataclass

import pandas as pd

from benchmark.common.tables import markdown_table
from benchmark.reporting.comparisons import (
    HIGHER,
    LOWER,
    NOT_DISTINGUISHABLE,
    RANDOM,
    difference_in_words,
    pairs_of,
    subjects_of,
    task_difference,
)
from benchmark.reporting.copies import without_copies
from benchmark.reporting.estimates import (
    FEWEST_RUNS,
    Estimate,
    cells_of,
    estimate,
    interquartile_mean,
    number_format,
)
from benchmark.reporting.scores import Study, score_table
from benchmark.reporting.sections import heading

NOTE = f"""\
A return is the interquartile mean of the final returns, with its 95 % interval; in a study of hyperparameters, over all of its
configurations. *Higher* and *lower* are differences of means whose whole 95 % interval lies on that side; nothing is concluded
from fewer than {FEWEST_RUNS} runs of a method."""


@dataclass(frozen=True)
class Level:
    """
    The final returns of a method on a task.

    :param method: the method
    :param reward: the interquartile mean
    """

    method: str
    reward: Estimate


def overview(studies: Sequence[Study], repetitions: int) -> str:
    """
    Tabulate what each study found on each task.

    :param studies: the studies
    :param repetitions: number of bootstrap samples
    :return: the section, in Markdown; empty before the first run of all has ended
    """
    rows = []
    for study in studies:
        table = score_table([study])
        tasks = list(dict.fromkeys([*study.facts["tasks"], *study.tasks]))
        for task in tasks:
            number = int((table["task"] == task).sum())
            planned = study.facts["runs_planned"] // len(tasks)
            ended = f"{number} of {planned} so far" if number < planned else str(number)
            place, found = f"{task}, {study.name}", "no run has ended"
            if number > 0:
                place, found = f"[{place}](#{anchor(heading(study, task))})", finding(study, table, task, repetitions)
            rows.append([place, f"{study.facts['steps']:,}", ended, found])
    if not rows:
        return ""
    table_ = markdown_table(["task and study", "steps", "runs", "finding"], rows, align="left")
    return "\n\n".join(["## Findings by task", table_, NOTE])


def finding(study: Study, table: pd.DataFrame, task: str, repetitions: int) -> str:
    """
    Say which method ended highest on a task, and how the methods of interest differ from the others.

    :param study: the study
    :param table: its runs' scores
    :param task: the task
    :param repetitions: number of bootstrap samples
    :return: sentences, in Markdown
    """
    runs = without_copies(table[table["task"] == task])
    form = number_format(runs["score"])
    methods = [method for method in dict.fromkeys(runs["method"]) if method != RANDOM] or [RANDOM]
    levels = [
        Level(method, estimate(interquartile_mean, [cells_of(runs[runs["method"] == method], "score")], repetitions))
        for method in methods
    ]
    levels.sort(key=lambda level: level.reward.value, reverse=True)
    sentences = [f"Highest: {levels[0].method}, {levels[0].reward.in_words(form)}."] if len(levels) > 1 else []
    if len(levels) == 1:
        sentences = [f"{levels[0].method}: {levels[0].reward.in_words(form)}."]
    for ours in subjects_of(study.methods):
        place = next((number for number, level in enumerate(levels) if level.method == ours), None)
        if place is None or len(levels) == 1:
            continue
        text = f"{ours}: rank {place + 1} of {len(levels)}"
        if place > 0:
            text += f", {levels[place].reward.in_words(form)}"
        sentences.append(text + ("" if study.axes else _differences(table, task, ours, methods)) + ".")
    few = [method for method in methods if (runs["method"] == method).sum() < FEWEST_RUNS]
    if few:
        sentences.append(f"**Too few runs of {', '.join(few)}: nothing is concluded on them.**")
    return " ".join(sentences)


def _differences(table: pd.DataFrame, task: str, ours: str, methods: Sequence[str]) -> str:
    words: dict[str, list[str]] = {}
    for pair in pairs_of(methods):
        found = task_difference(table, task, pair) if pair[0] == ours else None
        if found is not None:
            words.setdefault(difference_in_words(found), []).append(pair[1])
    told = [f"{word} than {', '.join(words[word])}" for word in (HIGHER, LOWER) if word in words]
    if NOT_DISTINGUISHABLE in words:
        equals = words[NOT_DISTINGUISHABLE]
        told.append(f"{NOT_DISTINGUISHABLE} from {'any other' if {*equals, ours} == set(methods) else ', '.join(equals)}")
    return "; " + "; ".join(told) if told else ""


def anchor(title: str) -> str:
    """
    Return the anchor that a Git host and MyST give to a heading.

    :param title: the heading
    :return: lower case, without punctuation, with hyphens for spaces
    """
    kept = "".join(letter for letter in title.lower() if letter.isalnum() or letter in " -_")
    return kept.replace(" ", "-")
