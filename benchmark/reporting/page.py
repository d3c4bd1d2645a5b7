"""The results page of sweeps: claims, tables and figures, with the commands that make them."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote

import pandas as pd

from benchmark.common.provenance import conditions_in_words
from benchmark.common.records import FINAL_EPISODES
from benchmark.common.tables import markdown_table
from benchmark.reporting.claims import RULES
from benchmark.reporting.comparisons import DIFFERENCES_RULE, differences_table, improvement_table
from benchmark.reporting.estimates import (
    REPETITIONS,
    cells_of,
    estimate,
    interquartile_mean,
    number_format,
)
from benchmark.reporting.literature import literature_section
from benchmark.reporting.scores import FAILURE_RULE, LENGTH_RULE, Study, failed, score_table
from benchmark.reporting.verdicts import OURS, Finding

INTRODUCTION = f"""\
# Results of sweeps

A run's score is the mean return of its final model over {FINAL_EPISODES} episodes, which are the same for all runs on a task.
The intervals do not contain the variance of the mean over other episodes, so small differences may be due to these episodes.
{FAILURE_RULE}
The figures and tables of a study use its own runs; the claims and the figure of all sweeps together use the runs of all
studies here. {LENGTH_RULE}
The time of inference was measured separately, by `python -m benchmark.runtime`.

Intervals are 95 % percentile bootstrap intervals by rliable; runs are drawn within each task and configuration. Few runs make
them too narrow: on normally distributed rewards, the interval of an interquartile mean of 2, 3, 4, 5, 10 runs contains the
true value in 52, 72, 88, 89, 93 % of the cases. There is no interval where a configuration has one run only.

{DIFFERENCES_RULE}"""
# Kinds of errors that are listed for a study
ERRORS = 5


@dataclass(frozen=True)
class Picture:
    """
    A figure on the page.

    :param path: its path within the page's folder
    :param caption: its caption
    :param content: the picture, as PNG
    """

    path: str
    caption: str
    content: bytes

    def in_words(self, command: str) -> str:
        """
        Return the figure in Markdown.

        :param command: the command that draws it
        :return: the figure, its caption and the command, in Markdown
        """
        return f"![{self.caption}]({quote(self.path)})\n\n{self.caption} `{command}`"


def study_section(study: Study, pictures: Sequence[Picture], command: str, repetitions: int = REPETITIONS) -> str:
    """
    Report on a study.

    :param study: the study
    :param pictures: its figures
    :param command: the command that draws them
    :param repetitions: number of bootstrap samples
    :return: the section, in Markdown
    """
    facts, table = study.facts, score_table([study])
    parts = [
        f"## {facts['title']}",
        progress(study),
        *ended_runs(study),
        f"{facts['settings_in_words']}\n\nSeeds {', '.join(map(str, facts['seeds']))}; {facts['steps']:,} steps, evaluated "
        f"every {facts['evaluation_interval']:,} by {facts['evaluation_episodes']} episodes.",
        *commands_in_words(facts["commands"]),
    ]
    if study.records:
        parts += [picture.in_words(command) for picture in pictures]
        parts += ["### Final rewards", *reward_tables(table, study, repetitions)]
        differences = "" if study.axes else differences_table(table, study.methods, repetitions)
        if differences:
            parts += ["### Differences between methods", differences]
        improvement = improvement_table(table, study.methods, repetitions)
        if improvement:
            parts += [f"### How often {OURS} improves", improvement]
        if not study.axes:
            parts += literature_section(study.tasks, facts["steps"])
    return "\n\n".join(parts)


def commands_in_words(commands: Sequence[dict[str, Any]]) -> list[str]:
    """
    Describe the commands that trained a study's runs.

    :param commands: the commands, from the first to the last
    :return: a paragraph for each, in Markdown
    """
    if len(commands) == 1:
        return [f"The runs: {conditions_in_words(commands[0])}"]
    return [
        f"From the time when {command['runs_ended']} runs had ended: {conditions_in_words(command)}" for command in commands
    ]


def progress(study: Study) -> str:
    """
    Describe the progress of a study, and the errors of its failed runs.

    :param study: the study
    :return: the lines, in Markdown
    """
    planned, lost = study.facts["runs_planned"], [record for record in study.records if failed(record)]
    lines = [f"{len(study.records):,} of {planned:,} planned runs have ended, {len(lost):,} of them failed."]
    if len(study.records) < planned:
        lines[0] += " **The rest is missing: the results below may change.**"
    reasons = Counter((record.method, _first_line(record.error or "the final reward is no number")) for record in lost)
    lines += [
        f"- {method}: `{reason}` ({number} run{'s' * (number > 1)})"
        for (method, reason), number in reasons.most_common(ERRORS)
    ]
    if len(reasons) > ERRORS:
        lines.append(f"- and {len(reasons) - ERRORS} other kinds of errors")
    return "\n".join(lines[:1] + [""] * bool(reasons) + lines[1:])


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
    planned = "" if study.axes else f" ({len(study.facts['seeds'])} seeds of each are planned)"
    return [f"Runs that have ended, by task and method{planned}:", markdown_table(["task", *study.methods], rows)]


def reward_tables(table: pd.DataFrame, study: Study, repetitions: int = REPETITIONS) -> list[str]:
    """
    Tabulate final rewards: by method, and, in a section that is folded, by configuration.

    :param table: the runs' scores
    :param study: the study
    :param repetitions: number of bootstrap samples
    :return: the tables, in Markdown
    """
    tables = [_reward_table(table, ["task", "method"], study, repetitions)]
    if study.axes:
        by_configuration = _reward_table(table, ["task", "settings", "method"], study, repetitions)
        tables.append(f"<details><summary>By configuration</summary>\n\n{by_configuration}\n\n</details>")
    return tables


def _reward_table(table: pd.DataFrame, columns: list[str], study: Study, repetitions: int) -> str:
    first = {text: number for number, text in enumerate(dict.fromkeys([*table["task"], *table["settings"], *study.methods]))}
    groups = [([str(name) for name in names], runs) for names, runs in table.groupby(columns)]
    rows = []
    for names, runs in sorted(groups, key=lambda group: [first[name] for name in group[0]]):
        form = number_format(table[table["task"] == names[0]]["score"])
        found = estimate(interquartile_mean, [cells_of(runs, "score")], repetitions)
        scores = runs["score"]
        numbers = [f"{value:{form}}" for value in (scores.mean(), scores.min(), scores.max())]
        rows.append([*names, found.in_words(form), *numbers, str(len(runs)), str(runs["failed"].sum())])
    header = [*columns, "interquartile mean (95 % interval)", "mean", "lowest", "highest", "runs", "failed"]
    return markdown_table(header, rows)


def _first_line(text: str) -> str:
    return (text.strip() or "no message").splitlines()[0].replace("`", "'")[:120]


def claims_section(findings: Sequence[Finding]) -> str:
    """
    Report on the paper's claims.

    :param findings: the findings on the claims
    :return: the section, in Markdown
    """
    rows = [[finding.claim, f"**{finding.verdict}**", finding.text] for finding in findings]
    table = markdown_table(["claim", "verdict", "what the data say"], rows, align="left")
    return "\n\n".join(["## The paper's claims", table, RULES])


def pooled_section(picture: Picture, command: str) -> str:
    """
    Report on several sweeps together.

    :param picture: their stability
    :param command: the command that draws it
    :return: the section, in Markdown
    """
    return f"## All sweeps together\n\n{picture.in_words(command)}"


def page(sections: Sequence[str]) -> str:
    """
    Return the page.

    :param sections: its sections
    :return: the page, in Markdown
    """
    return "\n\n".join([INTRODUCTION, *sections]) + "\n"
