"""Finished studies, and the score of each run: one table for all statistics and figures."""

import json
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmark.common.records import REWRITE, Record, read_description, read_records
from benchmark.reporting.copies import Configurations

FAILURE_RULE = (
    "A run that failed counts with the lowest return that any evaluation of any run on its task reached, and its learning "
    "curve continues at that return from its failure on."
)


@dataclass(frozen=True)
class Study:
    """
    A sweep, finished or still going on.

    :param name: the folder's name
    :param folder: its folder
    :param facts: the content of ``study.json``
    :param records: the runs that have ended
    """

    name: str
    folder: Path
    facts: dict[str, Any]
    records: list[Record]

    @property
    def methods(self) -> list[str]:
        """The methods, the planned ones first."""
        return list(dict.fromkeys([*self.facts["methods"], *(record.method for record in self.records)]))

    @property
    def tasks(self) -> list[str]:
        """The tasks of which a run has ended, the planned ones first."""
        ended = [record.task for record in self.records]
        return [task for task in dict.fromkeys([*self.facts["tasks"], *ended]) if task in ended]

    def planned_seeds(self, method: str) -> int:
        """
        Return the number of seeds with which a method is trained.

        :param method: the method
        :return: the number; that of all seeds for studies that earlier versions described
        """
        return self.facts.get("seeds_of_methods", {}).get(method, len(self.facts["seeds"]))

    def label(self, method: str, n_runs: int) -> str:
        """
        Return a method's name for a legend, with the number of its runs where some of its seeds are missing.

        :param method: the method
        :param n_runs: number of its runs
        :return: the name
        """
        planned = self.planned_seeds(method)
        return method if n_runs >= planned else f"{method} ({n_runs} of {planned} seeds)"

    @cached_property
    def axes(self) -> dict[str, list[Any]]:
        """The values of each axis that some run has, the planned ones first."""
        found: dict[str, list[Any]] = {}
        for record in self.records:
            for axis, value in record.settings.items():
                found.setdefault(axis, []).append(value)
        ordered = {}
        for axis, values in found.items():
            known = [*self.facts["axes"].get(axis, []), *values]
            ordered[axis] = [value for number, value in enumerate(known) if value in values and value not in known[:number]]
        return ordered

    def place(self, settings: dict[str, Any]) -> tuple[int, ...]:
        """
        Return the place of a configuration among all.

        :param settings: value by axis
        :return: the number of each axis's value; -1 for an axis that it lacks
        """
        return tuple(values.index(settings[axis]) if axis in settings else -1 for axis, values in self.axes.items())

    def in_order(self) -> list[Record]:
        """
        Sort the runs.

        :return: the runs by task, configuration, method and seed
        """
        tasks, methods = self.tasks, self.methods

        def key(record: Record) -> tuple[Any, ...]:
            return tasks.index(record.task), self.place(record.settings), methods.index(record.method), record.seed

        return sorted(self.records, key=key)


def experiment_number(study: Study) -> int | None:
    """
    Return the number of this project's experiment that a study is of.

    :param study: the study
    :return: such as 10 for the experiments e10 and e10-quick; None for the experiment of a user
    """
    number = re.fullmatch(r"e(\d+)(-.*)?", study.facts["experiment"])
    return int(number[1]) if number else None


def by_family(studies: Iterable[Study]) -> dict[str, list[Study]]:
    """
    Group studies by their experiment, whose tasks may be studies of their own.

    :param studies: the studies
    :return: studies by experiment. The files of one of this project's experiments are named after it: e10-quick and
        e10-locomotion are E10.
    """
    families: dict[str, list[Study]] = {}
    for study in studies:
        number = experiment_number(study)
        families.setdefault(study.facts["experiment"] if number is None else f"E{number}", []).append(study)
    return families


def read_study(folder: Path) -> Study:
    """
    Read a study.

    :param folder: its folder
    :return: the study
    :raises ValueError: if it is no study's folder, or a file of it is damaged; it names the file and the remedy
    """
    try:
        facts = read_description(folder)
        return Study(folder.resolve().name, folder, facts, read_records(folder, facts["steps"]))
    except FileNotFoundError as error:
        missing = Path(error.filename).name
        raise ValueError(f"{folder} is no folder of a study: {missing} is missing; {REWRITE}") from error


def settings_in_words(settings: dict[str, Any]) -> str:
    """
    Return the name of a configuration.

    :param settings: value by axis
    :return: such as "learning rate 0.001, batch size 64"; empty without an axis
    """
    return ", ".join(f"{axis_in_words(axis)} {value_in_words(value)}" for axis, value in settings.items())


def axis_in_words(axis: str) -> str:
    """
    Return the name of an axis.

    :param axis: the axis
    :return: its name for people
    """
    return axis.replace("_", " ")


def value_in_words(value: Any) -> str:
    """
    Return the name of an axis's value.

    :param value: the value
    :return: its name for people
    """
    if isinstance(value, float):
        short = f"{value:g}"
        # Other values must not have the same name
        return short if float(short) == value else repr(value)
    return value if isinstance(value, str) else json.dumps(value).replace('"', "")


def failed(record: Record) -> bool:
    """
    Return whether a run has no score of its own.

    :param record: the run
    :return: whether it raised an error
    """
    return record.final is None


def floors(records: Iterable[Record]) -> dict[str, float]:
    """
    Return the score of failed runs, as :data:`FAILURE_RULE` defines it.

    :param records: the runs
    :return: by task, the lowest return of any evaluation
    """
    lowest: dict[str, float] = {}
    for record in records:
        finals = [] if record.final is None else [record.final]
        returns = [value for value in (*record.returns, *finals) if math.isfinite(value)]
        lowest[record.task] = min([lowest.get(record.task, math.inf), *returns])
    # Where every run failed before its first evaluation, any number ties them
    return {task: value if math.isfinite(value) else 0.0 for task, value in lowest.items()}


def score_table(studies: Sequence[Study]) -> pd.DataFrame:
    """
    Score the runs of studies.

    :param studies: the studies
    :return: a row per run: study, method, task (with the steps where runs on it differ in them), settings, cell (what it
        shares with the runs that differ from it in method and seed only), trained (what it shares with the runs of its method
        that differ from it in the seed only, in any study), seed, failed, score, floor (the task's lowest
        return of any evaluation), range (from the floor to the task's best score), and share (of the range, from the floor)
    """
    runs = [
        (study.name, configurations, record)
        for study, configurations in ((study, Configurations(study.facts)) for study in studies)
        for record in study.in_order()
    ]
    lowest = floors(record for *_, record in runs)
    budgets: dict[str, set[int]] = {}
    for *_, record in runs:
        budgets.setdefault(record.task, set()).add(record.steps)
    rows = []
    for study, configurations, record in runs:
        several = len(budgets[record.task]) > 1
        settings = settings_in_words(record.settings)
        cell = f"{study} {record.task} {record.steps} {settings}"
        rows.append(
            {
                "study": study,
                "method": record.method,
                "task": f"{record.task}, {record.steps:,} steps" if several else record.task,
                "settings": settings,
                "values": record.settings,
                "cell": cell,
                "trained": configurations.of(record, cell),
                "seed": record.seed,
                "failed": failed(record),
                "score": lowest[record.task] if record.final is None else record.final,
                "floor": lowest[record.task],
            }
        )
    columns = ["study", "method", "task", "settings", "values", "cell", "trained", "seed", "failed", "score", "floor"]
    table = pd.DataFrame(rows, columns=columns)
    height = table["score"] - table["floor"]
    table["range"] = height.groupby(table["task"]).transform("max")
    table["share"] = (height / table["range"].where(table["range"] > 0)).fillna(0.0).astype(float)
    return table


def evaluation_grid(records: Iterable[Record], task: str) -> np.ndarray:
    """
    List when a task's runs were evaluated, as long as all of those that did not fail were: some algorithms train for longer
    than they are told.

    :param records: the runs
    :param task: the task
    :return: environment steps (E) of all evaluations until then; none if every run failed before its first
    """
    runs = [record for record in records if record.task == task and record.timesteps]
    last = min((record.timesteps[-1] for record in runs if not failed(record)), default=math.inf)
    return np.unique([step for record in runs for step in record.timesteps if step <= last]).astype(float)


def curves(records: Sequence[Record], floor: float, grid: np.ndarray) -> np.ndarray:
    """
    Return learning curves on a common grid.

    :param records: the runs, at least one
    :param floor: the return of a failed run after its failure
    :param grid: environment steps (E)
    :return: returns (N, E), interpolated linearly between evaluations
    """
    lines = np.full((len(records), len(grid)), float(floor))
    for line, record in zip(lines, records, strict=True):
        timesteps, returns = np.array(record.timesteps, dtype=float), np.array(record.returns, dtype=float)
        known = np.isfinite(returns)
        if known.any():
            # A failed run has returns before its failure only
            shown = grid <= timesteps[known][-1] if failed(record) else np.ones(len(grid), dtype=bool)
            line[shown] = np.interp(grid[shown], timesteps[known], returns[known])
    return lines
