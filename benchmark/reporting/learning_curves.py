"""Learning curves: by environment steps, beside published returns, and by minutes of processor time."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmark.common.canvas import BAND, count_steps, draw_line, draw_seeds, label_below, legend, panels, png, styled
from benchmark.common.records import Record, entries_by_task
from benchmark.common.style import styles
from benchmark.reporting.comparisons import RANDOM
from benchmark.reporting.estimates import bootstrap, interquartile_mean
from benchmark.reporting.literature import Published, published
from benchmark.reporting.machines import processors_of_run, processors_of_runs
from benchmark.reporting.scores import Study, curves, evaluation_grid, failed, floors

# The most curves in one panel; a study of more methods has a panel for each, beside the same reference
MAX_CURVES_PER_PANEL = 4
REFERENCE = "TD3"
BESIDE: dict[str, Any] = dict(color="#8A8A8A", linestyle="--", linewidth=1.6)
ALONE = (5.6, 3.6)


@styled
def curves_by_steps(study: Study, task: str, repetitions: int) -> bytes:
    """
    Draw a task's learning curves: every seed, their interquartile mean, and its 95 % interval. Published mean returns within
    the range of steps are open markers.

    :param study: the study
    :param task: the task
    :param repetitions: number of bootstrap samples
    :return: the picture, as PNG
    """
    records = [record for record in study.records if record.task == task]
    figure, drawn = _figure(study, task, records, lambda method, grid: grid, repetitions)
    count_steps(list(drawn.values()))
    for entry in published(task, study.facts["steps"]):
        place = entry.method if entry.method in drawn else ""
        if place in drawn:
            _mark(drawn[place], entry)
            means = [mean for mean, _ in entry.returns.values()]
            drawn[place].set_ylim(learnt_range(np.array([*drawn[place].get_ylim(), *means]), margin=0.0))
    legend(figure, list(drawn.values()), task)
    return png(figure)


@styled
def curves_by_minutes(study: Study, task: str, repetitions: int) -> bytes:
    """
    Draw a task's learning curves by processor time: the same, without runs that have no time.

    :param study: the study
    :param task: the task, of which :func:`times_of` finds runs
    :param repetitions: number of bootstrap samples
    :return: the picture, as PNG
    """
    times = times_of(study, task)
    figure, drawn = _figure(study, task, times.runs, times.minutes, repetitions)
    label_below(list(drawn.values()), "minutes of processor time")
    legend(figure, list(drawn.values()), task)
    return png(figure)


@dataclass(frozen=True)
class Times:
    """
    The times of a task's runs.

    :param runs: the runs that curves by minutes show
    :param minutes_per_step: of a step after the random ones at the start, by method
    :param random_steps: the number of random steps at the start, by method
    :param processors: the processors on which these minutes were measured
    :param all_processors: those of all runs
    :param elsewhere: the methods that are left out, as they were trained on other processors only
    """

    runs: list[Record]
    minutes_per_step: dict[str, float]
    random_steps: dict[str, int]
    processors: list[str]
    all_processors: list[str]
    elsewhere: list[str]

    def minutes(self, method: str, grid: np.ndarray) -> np.ndarray:
        """
        Return when a method reaches steps.

        :param method: the method
        :param grid: environment steps (E)
        :return: minutes (E)
        """
        return np.maximum(grid - self.random_steps[method], 0) * self.minutes_per_step[method]


def times_of(study: Study, task: str) -> Times:
    """
    Return a task's runs that curves by minutes show, and how long each method trains.

    The time of a run is shared evenly among its steps after the random ones at the start, which need little. An evaluation of
    a method stands at the median of its runs' times, of those on the processor that trained the most methods, and the most
    runs of them; of all runs, if no processor trained two methods. A failed run has the time of the method's other runs, as
    the step at which it failed is not recorded.

    :param study: the study
    :param task: the task
    :return: the times of :func:`timed_methods`, without those of which no complete run on that processor has a time
    """
    shown = timed_methods(study, task)
    records = [record for record in study.records if record.task == task and record.method in shown]
    measured = [record for record in records if record.processor_seconds is not None]
    complete = [record for record in measured if not failed(record)]
    compared = _on_one_processor(study, complete)
    seconds: dict[str, list[float]] = {}
    random_steps = {method: _random_steps(_entry(study, method, task)) for method in shown}
    for record in compared:
        # Some algorithms train for longer than they are told
        steps = max([record.steps, *record.timesteps])
        trained = max(steps - random_steps[record.method], 1)
        seconds.setdefault(record.method, []).append((record.processor_seconds or 0.0) / trained)
    paces = {method: float(np.median(each)) / 60 for method, each in seconds.items()}
    kept = [record for record in measured if record.method in paces]
    elsewhere = [method for method in dict.fromkeys(record.method for record in complete) if method not in paces]
    used, known = processors_of_runs(study, compared), processors_of_runs(study, measured)
    return Times(kept, paces, random_steps, used, known, elsewhere)


def _on_one_processor(study: Study, runs: Sequence[Record]) -> Sequence[Record]:
    """Return the runs on the processor that trained the most methods, and the most runs; all runs if none trained two."""
    by_processor: dict[str, list[Record]] = {}
    for run in runs:
        if len(names := processors_of_run(study, run)) == 1:
            by_processor.setdefault(names[0], []).append(run)

    def methods(some: Sequence[Record]) -> int:
        return len({run.method for run in some})

    most = max((by_processor[name] for name in sorted(by_processor)), key=lambda some: (methods(some), len(some)), default=[])
    return most if methods(most) >= min(2, methods(runs)) else runs


def shown_methods(study: Study, task: str) -> list[str]:
    """
    List the methods that a task's learning curves show.

    :param study: the study
    :param task: the task
    :return: those that have runs, without random actions, whose level would squash the others' curves
    """
    ran = {record.method for record in study.records if record.task == task}
    learners = [method for method in study.methods if method in ran and method != RANDOM]
    return learners or [method for method in study.methods if method in ran]


def timed_methods(study: Study, task: str) -> list[str]:
    """
    List the methods whose learning curves can be drawn by minutes.

    :param study: the study
    :param task: the task
    :return: those of :func:`shown_methods`, without those that spend most of their time after their last step
    """
    shown = shown_methods(study, task)
    return [method for method in shown if _entry(study, method, task).get("policy_training") != "offline"]


def _entry(study: Study, method: str, task: str) -> dict[str, Any]:
    """Return the hyperparameters of a method, as far as the study's description has them."""
    return entries_by_task(study.facts).get((method, task), {})


def _random_steps(entry: dict[str, Any]) -> int:
    """Return the number of random steps at the start of a configuration's runs."""
    if "learning_starts" in entry or "algo" not in entry:
        return int(entry.get("learning_starts", 0))
    # rl_zoo3 takes a second to import, and only defaults need it
    from benchmark.common.zoo import random_steps

    return random_steps(entry["algo"], entry)


def _figure(
    study: Study, task: str, records: Sequence[Record], place: Callable[[str, np.ndarray], np.ndarray], repetitions: int
) -> tuple[Figure, dict[str, Axes]]:
    """Draw each method's runs at the places of its steps. The panels are by method, or the only one is that of all, ""."""
    by_method = {method: [record for record in records if record.method == method] for method in shown_methods(study, task)}
    by_method = {method: runs for method, runs in by_method.items() if runs}
    floor, grid = floors(study.records)[task], evaluation_grid(records, task)
    lines = {method: curves(runs, floor, grid) for method, runs in by_method.items()}
    looks = styles(study.methods)
    is_alone = len(by_method) <= MAX_CURVES_PER_PANEL
    figure, axes = panels(1, size=ALONE) if is_alone else panels(len(by_method), columns=3)
    drawn = {"": axes[0]} if is_alone else dict(zip(by_method, axes, strict=True))
    reference = REFERENCE if REFERENCE in by_method else next(iter(by_method))
    for method, runs in by_method.items():
        panel, x = drawn["" if is_alone else method], place(method, grid)
        if len(grid) == 0:
            continue
        if not is_alone:
            panel.set_title(study.label(method, len(runs)).replace(" (", "\n("))
            if method != reference:
                beside = interquartile_mean(lines[reference][None])[0]
                panel.plot(place(reference, grid), beside, label=f"{reference}, in all panels", **BESIDE)
        draw_seeds(panel, x, lines[method], looks[method]["color"])
        middle, interval = bootstrap(interquartile_mean, [{"": lines[method]}], repetitions)
        label, look = (
            (study.label(method, len(runs)), looks[method]) if is_alone else ("_method", looks[method] | {"linestyle": "-"})
        )
        draw_line(panel, x, middle, label, look)
        if interval is not None:
            panel.fill_between(x, *interval, color=looks[method]["color"], **BAND)
    for panel in axes[:: 1 if is_alone else 3]:
        panel.set_ylabel("return")
    show_learnt_range(axes[0], study, grid, list(lines.values()))
    return figure, drawn


def first_training_step(study: Study) -> int:
    """
    Return the step at which the last method of a study begins to learn.

    :param study: the study
    :return: the most random steps at the start that one of its configurations takes
    """
    configurations = study.facts.get("configurations", {}).values()
    return max(map(_random_steps, configurations), default=0)


def show_learnt_range(panel: Axes, study: Study, grid: np.ndarray, lines: Sequence[np.ndarray]) -> None:
    """
    Limit the vertical axis to the evaluations after the first training step, if there are any.

    :param panel: the axes
    :param study: the study
    :param grid: environment steps of the evaluations (E)
    :param lines: each method's returns, (runs, E)
    """
    trained = np.concatenate([line[:, grid > first_training_step(study)].ravel() for line in lines])
    if trained.size:
        panel.set_ylim(learnt_range(trained))


def learnt_range(returns: np.ndarray, margin: float = 0.04) -> tuple[float, float]:
    """
    Return the range of the vertical axis.

    :param returns: the returns of all evaluations after the first training step (N), at least one
    :param margin: the margin on each side, as a share of their range
    :return: their range, with the margin
    """
    low, high = float(returns.min()), float(returns.max())
    beyond = margin * (high - low) if high > low else 1.0
    return low - beyond, high + beyond


def _mark(panel: Axes, entry: Published) -> None:
    (look,) = styles([entry.method]).values()
    steps, means = list(entry.returns), [mean for mean, _ in entry.returns.values()]
    marks = dict(look, linestyle="none", markerfacecolor="none", markersize=9, markeredgewidth=1.8, clip_on=False)
    panel.plot(steps, means, label=f"{entry.method}, literature, {entry.version}", **marks)
