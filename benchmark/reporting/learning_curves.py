"""Learning curves: by environment steps, beside published returns, and by minutes of processor time."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmark.common.records import Record
from benchmark.common.style import styles
from benchmark.reporting.drawing import draw_line, label_steps, legend, panels, png
from benchmark.reporting.estimates import REPETITIONS, bootstrap, interquartile_mean
from benchmark.reporting.literature import published
from benchmark.reporting.scores import Study, curves, evaluation_grid, failed, floors


def curves_by_steps(study: Study, task: str, repetitions: int = REPETITIONS) -> bytes:
    """
    Draw a task's learning curves: mean and range over seeds, as the paper, and interquartile mean with its 95 % interval.
    Published mean returns within the range of steps are hollow markers beside the means.

    :param study: the study
    :param task: the task
    :param repetitions: number of bootstrap samples
    :return: the picture, as PNG
    """
    records = [record for record in study.records if record.task == task]
    figure, drawn = _figure(study, task, records, dict.fromkeys(study.methods, 1.0), repetitions)
    for panel in drawn:
        label_steps(panel)
    for entry in published(task, study.facts["steps"]):
        (look,) = styles([entry.method]).values()
        steps, means = list(entry.returns), [mean for mean, _ in entry.returns.values()]
        marks = dict(look, linestyle="none", markerfacecolor="none", markersize=8, markeredgewidth=1.6, clip_on=False)
        drawn[0].plot(steps, means, label=f"{entry.method}, literature, {entry.version}", **marks)
    legend(figure, drawn[:1], task)
    return png(figure)


def curves_by_minutes(study: Study, task: str, repetitions: int = REPETITIONS) -> bytes:
    """
    Draw a task's learning curves by processor time: the same means and intervals, without runs that have no time.

    :param study: the study
    :param task: the task, of which :func:`timed_runs` finds runs
    :param repetitions: number of bootstrap samples
    :return: the picture, as PNG
    """
    records, minutes_per_step = timed_runs(study, task)
    figure, drawn = _figure(study, task, records, minutes_per_step, repetitions)
    for panel in drawn:
        panel.set_xlabel("minutes of processor time")
    legend(figure, drawn[:1], task)
    return png(figure)


def timed_runs(study: Study, task: str) -> tuple[list[Record], dict[str, float]]:
    """
    Return a task's runs that curves by minutes show, and how long each method trains.

    The time of a run is shared evenly among its steps, so that an evaluation takes place at ``processor_seconds`` times
    its step, divided by the run's steps. An evaluation of a method stands at the mean of its runs' times. A failed run has
    the time of the method's other runs, as the step at which it failed is not recorded.

    :param study: the study
    :param task: the task
    :return: the runs, and the minutes per step by method; without methods of which no complete run has a time
    """
    measured = [record for record in study.records if record.task == task and record.processor_seconds is not None]
    minutes: dict[str, list[float]] = {}
    for record in measured:
        if record.processor_seconds is not None and not failed(record):
            minutes.setdefault(record.method, []).append(record.processor_seconds / 60 / record.steps)
    paces = {method: float(np.mean(each)) for method, each in minutes.items()}
    return [record for record in measured if record.method in paces], paces


def _figure(
    study: Study, task: str, records: Sequence[Record], units_per_step: Mapping[str, float], repetitions: int
) -> tuple[Figure, list[Axes]]:
    """Draw both statistics of each method's runs against its steps in some unit."""
    figure, (left, right) = panels(2)
    floor, grid = floors(study.records)[task], evaluation_grid(records, task)
    for method, look in styles(study.methods).items():
        runs = [record for record in records if record.method == method]
        if not runs or len(grid) == 0:
            continue
        x, lines = grid * units_per_step[method], curves(runs, floor, grid)
        draw_line(left, x, lines.mean(axis=0), _label(study, method, runs), look)
        left.fill_between(x, lines.min(axis=0), lines.max(axis=0), color=look["color"], alpha=0.12, linewidth=0)
        middle, interval = bootstrap(interquartile_mean, [[lines]], repetitions)
        draw_line(right, x, middle, method, look)
        if interval is not None:
            right.fill_between(x, *interval, color=look["color"], alpha=0.12, linewidth=0)
    left.set(title="mean, and range over seeds", ylabel="return")
    right.set(title="interquartile mean, 95 % interval")
    return figure, [left, right]


def _label(study: Study, method: str, runs: Sequence[Record]) -> str:
    """Return a method's name, with the number of its runs where some of its seeds are missing."""
    planned = len(study.facts["seeds"])
    return method if len(runs) >= planned else f"{method} ({len(runs)} of {planned} seeds)"
