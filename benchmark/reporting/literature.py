"""Returns that others have published, for the figures and tables of learning curves."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from benchmark.common.tables import markdown_table

FILE = Path(__file__).parent / "literature.yml"
NOTE = """\
These returns are from the literature and were not measured here: means ± standard deviations over seeds, computed from
published learning curves (`benchmark/reporting/literature.yml`). The names of the tasks have the versions of the
environments: the reward and the dynamics of HalfCheetah-v5 are those of v4, but Hopper, Ant and Humanoid changed in v5,
so that returns of other versions are a rough guide only."""


@dataclass(frozen=True)
class Published:
    """
    One method's published returns on one task.

    :param method: the method
    :param version: the environment's version, such as "v4"
    :param seeds: the number of seeds
    :param source: the authors and the place of the records
    :param task: the environment's name without its version
    :param returns: mean and standard deviation over seeds, by environment steps
    """

    method: str
    version: str
    seeds: int
    source: str
    task: str
    returns: dict[int, tuple[float, float]]


@cache
def _all_published() -> tuple[Published, ...]:
    """Read the file."""
    entries: list[dict[str, Any]] = yaml.safe_load(FILE.read_text())
    return tuple(
        Published(
            **{name: value for name, value in entry.items() if name != "returns"},
            task=task,
            returns={step: (mean, std) for step, (mean, std) in returns.items()},
        )
        for entry in entries
        for task, returns in entry["returns"].items()
    )


def published(task: str, steps: int) -> list[Published]:
    """
    Return the published returns that belong beside a task's learning curves.

    :param task: the environment's id; its version may be another one
    :param steps: environment steps of the curves, up to which returns are taken
    :return: an entry per method; none for a task without published returns
    """
    name = re.sub(r"-v\d+$", "", task)
    within = [
        replace(entry, returns={step: value for step, value in entry.returns.items() if step <= steps})
        for entry in _all_published()
        if entry.task == name
    ]
    return [entry for entry in within if entry.returns]


def literature_section(tasks: Sequence[str], steps: int) -> list[str]:
    """
    Tabulate published returns beside those of a study.

    :param tasks: the study's tasks
    :param steps: environment steps of its runs
    :return: the section's paragraphs, in Markdown; none without published returns
    """
    entries = [entry for task in tasks for entry in published(task, steps)]
    if not entries:
        return []
    rows = [
        [f"{entry.task}-{entry.version}", entry.method, f"{step:,}", f"{mean:g} ± {std:g}"]
        for entry in entries
        for step, (mean, std) in entry.returns.items()
    ]
    sources = dict.fromkeys(f"- {entry.method}, {entry.seeds} seeds: {entry.source}" for entry in entries)
    table = markdown_table(["task", "method", "steps", "return"], rows)
    return ["**From the literature**", table, NOTE, "\n".join(sources)]
