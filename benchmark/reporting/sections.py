"""The sections of the results page on one study: a section for each of its tasks, with figures, tables and commands."""

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

import pandas as pd

from benchmark.common.provenance import conditions_in_words
from benchmark.common.records import RUNS
from benchmark.common.tables import markdown_table
from benchmark.reporting.comparisons import differences_table, improvement_table, subjects_of
from benchmark.reporting.copies import without_copies
from benchmark.reporting.estimates import FEWEST_RUNS, cells_of, estimate, interquartile_mean, number_format
from benchmark.reporting.literature import literature_section
from benchmark.reporting.machines import different_processors
from benchmark.reporting.scores import Study, experiment_number, failed, score_table

# Kinds of errors that are listed for a study
ERRORS = 5
FINAL_REWARDS = "**Final returns**"


@dataclass(frozen=True)
class Picture:
    """
    A figure on the page.

    :param path: its path within the page's folder
    :param title: what it shows, for those who do not see it
    :param caption: its caption
    :param content: the picture, as PNG
    :param task: the task that it shows; None for all tasks of a study
    """

    path: str
    title: str
    caption: str
    content: bytes
    task: str | None = None

    def in_words(self) -> str:
        """
        Return the figure in Markdown.

        :return: the figure and its caption
        """
        return f"![{self.title}]({quote(self.path)})\n\n*{self.caption}*"


def fold(title: str, *parts: str) -> str:
    """
    Return text that is hidden until a reader opens it, on a Git host and in Sphinx's pages.

    :param title: the line that is always shown
    :param parts: the hidden paragraphs, in Markdown
    :return: the HTML element, around Markdown
    """
    return "\n\n".join([f"<details><summary>{title}</summary>", *parts, "</details>"])


def heading(study: Study, task: str | None = None) -> str:
    """
    Return the heading of a section.

    :param study: the study
    :param task: the task; None for the section on all tasks of a study
    :return: the title with the task, the methods and the study's name
    """
    title = study.facts["title"]
    if experiment_number(study) is not None:
        # The titles of this project's own files begin with an ordinary word
        title = title[0].lower() + title[1:]
    # All planned methods, so that links to the section hold while runs end
    who = ", ".join(study.methods) if len(study.methods) <= 4 else f"{len(study.methods)} methods"
    text = f"{title}, {who} ({study.name})" if study.methods else f"{title} ({study.name})"
    return f"{task}: {text}" if task is not None else text[0].upper() + text[1:]


def study_sections(study: Study, pictures: Sequence[Picture], command: str, out: Path, repetitions: int) -> list[str]:
    """
    Report on a study: in a section for each task; before them, for several tasks, in one on all of them.

    :param study: the study
    :param pictures: its figures
    :param command: the command that draws them
    :param out: the folder of the page
    :param repetitions: number of bootstrap samples
    :return: the sections, in Markdown
    """
    table, tasks = score_table([study]), study.tasks
    about = [*state(study), conditions(study)]
    shared = [picture.in_words() for picture in pictures if picture.task is None]
    comparisons = comparison_tables(table, study, repetitions)
    record = conditions_fold(study, command, out)
    if len(tasks) == 1:
        own = [picture.in_words() for picture in pictures if picture.task is not None]
        rewards = [FINAL_REWARDS, *reward_tables(table, study, repetitions)]
        literature = literature_of(study, tasks[0])
        return [_section(heading(study, tasks[0]), about, own, shared, rewards, comparisons, literature, [record])]
    sections = [_section(heading(study), about, shared, comparisons, [record])]
    for task in tasks:
        own = [picture.in_words() for picture in pictures if picture.task == task]
        rewards = [FINAL_REWARDS, *reward_tables(table[table["task"] == task], study, repetitions)]
        sections.append(_section(heading(study, task), own, rewards, literature_of(study, task)))
    return sections


def _section(title: str, *blocks: Sequence[str]) -> str:
    return "\n\n".join([f"## {title}", *(part for block in blocks for part in block)])


def literature_of(study: Study, task: str) -> list[str]:
    """
    Tabulate published returns beside a task's learning curves.

    :param study: the study
    :param task: the task
    :return: paragraphs, in Markdown; none for a study with axes, or without published returns
    """
    return [] if study.axes else literature_section([task], study.facts["steps"])


def state(study: Study) -> list[str]:
    """
    Describe the progress of a study, and the errors of its failed runs.

    :param study: the study
    :return: paragraphs, in Markdown
    """
    ended, planned = len(study.records), study.facts["runs_planned"]
    lost = [record for record in study.records if failed(record)]
    lines = [f"{ended:,} of {planned:,} planned runs have ended, {len(lost):,} of them failed."]
    if ended < planned:
        lines[0] += " **The rest is missing: the results below may change.**"
    reasons = Counter((record.method, _first_line(record.error or "")) for record in lost)
    errors = [
        f"- {method}: `{reason}` ({number} run{'s' * (number > 1)})"
        for (method, reason), number in reasons.most_common(ERRORS)
    ]
    if len(reasons) > ERRORS:
        errors.append(f"- and {len(reasons) - ERRORS} other kinds of errors")
    return [*lines, *(["\n".join(errors)] if errors else []), *ended_runs(study)]


def ended_runs(study: Study) -> list[str]:
    """
    Tabulate how many runs of an unfinished study have ended, by task and method.

    :param study: the study
    :return: the table, in Markdown; none for a study that is finished, or of which no run has ended
    """
    if not study.records or len(study.records) >= study.facts["runs_planned"]:
        return []
    number = Counter((record.task, record.method) for record in study.records)
    tasks = dict.fromkeys([*study.facts["tasks"], *study.tasks])
    rows = [[task, *(str(number[task, method]) for method in study.methods)] for task in tasks]
    planned = "" if study.axes else f" ({_planned(study)})"
    return [f"Runs that have ended, by task and method{planned}:", markdown_table(["task", *study.methods], rows)]


def _planned(study: Study) -> str:
    numbers = {method: study.planned_seeds(method) for method in study.methods}
    if len(set(numbers.values())) == 1:
        return f"{numbers[study.methods[0]]} seeds of each are planned"
    return "planned seeds: " + ", ".join(f"{number} of {method}" for method, number in numbers.items())


def conditions(study: Study) -> str:
    """
    Describe the lengths, the seeds and the hyperparameters that all learners of a study share.

    :param study: the study
    :return: the paragraph, in Markdown
    """
    facts = study.facts
    text = (
        f"Seeds {', '.join(map(str, facts['seeds']))}; {facts['steps']:,} steps, evaluated "
        f"every {facts['evaluation_interval']:,} by {facts['evaluation_episodes']} episodes."
    )
    learners = [entry for entry in facts.get("configurations", {}).values() if entry["algo"] != "random"]
    shared = [
        f"`{name}` {value}"
        for name, value in (learners[0].items() if learners else ())
        if name not in ("algo", "policy") and all(entry.get(name) == value for entry in learners)
    ]
    return text + (f" All learners: {', '.join(shared)}." if shared else "")


def conditions_fold(study: Study, command: str, out: Path) -> str:
    """
    Describe the commands that trained a study's runs and that draw its figures, with machines, commits and versions.

    :param study: the study
    :param command: the command that draws its figures
    :param out: the folder of the page
    :return: a section that is folded, in Markdown
    """
    commands = study.facts["commands"]
    trained = [f"From the time when {each['runs_ended']} runs had ended: {conditions_in_words(each)}" for each in commands]
    if len(commands) == 1:
        trained = [f"The runs: {conditions_in_words(commands[0])}"]
    path = quote(Path(os.path.relpath(study.folder / RUNS, out)).as_posix())
    # The changes to the experiment's file, if any
    changes = [f"Settings: {study.facts['settings_in_words']}"] * bool(study.facts["settings_in_words"])
    figures = [f"The figures: `{command}`."] * bool(study.records)
    return fold(
        "Commands, machines, commits, versions, records", f"The records: [{RUNS}]({path}).", *changes, *figures, *trained
    )


def comparison_tables(table: pd.DataFrame, study: Study, repetitions: int) -> list[str]:
    """
    Compare the methods of a study.

    :param table: the runs' scores
    :param study: the study
    :param repetitions: number of bootstrap samples
    :return: the tables, in Markdown; in place of them a sentence while no method has enough runs
    """
    if table.empty:
        return []
    if table.groupby(["task", "method"]).size().max() < FEWEST_RUNS:
        return [f"Methods are compared from {FEWEST_RUNS} runs on, which none of them has yet."]
    parts = []
    differences = "" if study.axes else differences_table(table, study.methods)
    if differences:
        parts += ["**Differences between methods**", differences, *different_processors(study)]
    # The paper's method, rather than the light setting
    for subject in subjects_of(study.methods)[-1:]:
        improvement = improvement_table(table, subject, study.methods, repetitions)
        if improvement:
            parts.append(fold(f"Probability that {subject} improves on the others", improvement))
    return parts


def reward_tables(table: pd.DataFrame, study: Study, repetitions: int) -> list[str]:
    """
    Tabulate final returns: by method, and, in a section that is folded, by configuration.

    :param table: the runs' scores
    :param study: the study
    :param repetitions: number of bootstrap samples
    :return: the tables, in Markdown
    """
    tables = [_reward_table(table, ["task", "method"], study, repetitions)]
    if study.axes:
        tables.append(fold("By configuration", _reward_table(table, ["task", "settings", "method"], study, repetitions)))
    return tables


def _reward_table(table: pd.DataFrame, columns: list[str], study: Study, repetitions: int) -> str:
    first = {text: number for number, text in enumerate(dict.fromkeys([*table["task"], *table["settings"], *study.methods]))}
    groups = [([str(name) for name in names], runs) for names, runs in table.groupby(columns)]
    rows = []
    for names, runs in sorted(groups, key=lambda group: [first[name] for name in group[0]]):
        form = number_format(table[table["task"] == names[0]]["score"])
        found = estimate(interquartile_mean, [cells_of(runs, "score")], repetitions)
        runs = without_copies(runs)
        scores = runs["score"]
        numbers = [f"{value:{form}}" for value in (scores.mean(), scores.min(), scores.max())]
        planned = study.planned_seeds(names[-1])
        ended = f"{len(runs)} of {planned} so far" if not study.axes and len(runs) < planned else str(len(runs))
        rows.append([*names, found.in_words(form), *numbers, ended, str(runs["failed"].sum())])
    header = [*columns, "interquartile mean (95 % interval)", "mean", "lowest", "highest", "runs", "failed"]
    return markdown_table(header, rows)


def _first_line(text: str) -> str:
    return (text.strip() or "no message").splitlines()[0].replace("`", "'")[:120]
