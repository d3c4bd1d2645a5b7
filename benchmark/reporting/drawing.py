"""The figures of a study: stability, sensitivity to each axis, final returns."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from benchmark.common.canvas import BAND, SEED, count_steps, draw_line, legend, panels, png, styled
from benchmark.common.style import styles
from benchmark.reporting.comparisons import RANDOM
from benchmark.reporting.estimates import (
    bootstrap,
    cells_of,
    estimate,
    interquartile_mean,
    share_reaching,
)
from benchmark.reporting.scores import Study, axis_in_words, curves, evaluation_grid, floors, value_in_words

LINE_STYLES: list[Any] = ["-", "--", "-.", ":", (0, (4, 1, 1, 1, 1, 1)), (0, (8, 2))]
MARKERS = "osD^vXP"
# Methods differ where the highest and the lowest of their shares are this far apart
DIFFERENCE = 0.15
RUNS_THAT_REACH_IT = "runs that reach it, %"


@styled
def stability(table: pd.DataFrame, methods: Sequence[str], repetitions: int) -> bytes:
    """
    Draw the share of runs that reach at least a reward, with its 95 % band, over the rewards at which methods differ.

    :param table: the runs' scores
    :param methods: the methods, in the legend's order
    :param repetitions: number of bootstrap samples
    :return: the picture, as PNG
    """
    tasks = list(dict.fromkeys(table["task"]))
    figure, grid = panels(len(tasks), columns=min(len(tasks), 2), size=(5.0, 3.0) if len(tasks) == 1 else (3.7, 2.8))
    for task, panel in zip(tasks, grid, strict=True):
        draw_stability(panel, table[table["task"] == task], methods, repetitions)
        panel.set_title(task)
    for panel in grid[::2]:
        panel.set_ylabel(RUNS_THAT_REACH_IT)
    legend(figure, grid)
    return png(figure)


def draw_stability(panel: Axes, runs: pd.DataFrame, methods: Sequence[str], repetitions: int) -> None:
    """
    Draw the share of a task's runs that reach at least a reward into a panel.

    :param panel: the panel
    :param runs: the scores of the task's runs
    :param methods: the methods, in the legend's order
    :param repetitions: number of bootstrap samples
    """
    levels, shares = np.unique(runs["score"]), []
    for method, look in styles(methods).items():
        cells = cells_of(runs[runs["method"] == method], "score")
        if not cells:
            continue
        share, band = bootstrap(lambda scores: share_reaching(scores, levels), [cells], repetitions)
        shares.append(share)
        draw_line(panel, levels, 100 * share, method, look, drawstyle="steps-pre")
        if band is not None:
            panel.fill_between(levels, 100 * band[0], 100 * band[1], step="pre", color=look["color"], **BAND)
    panel.set(xlabel="final return", ylim=(-3, 103), xlim=differing_range(levels, np.array(shares)))


def differing_range(levels: np.ndarray, shares: np.ndarray) -> tuple[float, float]:
    """
    Return the range of rewards at which methods differ.

    :param levels: rewards, ascending (L)
    :param shares: for each method, the share of its runs that reach them (M, L)
    :return: the range, with a margin; that of all rewards where methods never differ
    """
    differs = np.flatnonzero(shares.max(axis=0) - shares.min(axis=0) > DIFFERENCE)
    first = levels[differs[0]] if len(differs) > 0 else levels[0]
    margin = 0.03 * float(levels[-1] - first) or 1.0
    return float(first) - margin, float(levels[-1]) + margin


@styled
def sensitivity(study: Study, task: str) -> bytes:
    """
    Draw a task's learning curves for each configuration, interquartile means over seeds and every seed: a column of panels for
    each method, a row for each combination of values of all axes but the last, and a line for each value of the last axis.

    :param study: the study, with an axis
    :param task: the task
    :return: the picture, as PNG
    """
    records = [record for record in study.records if record.task == task]
    floor, grid = floors(study.records)[task], evaluation_grid(study.records, task)
    methods = [method for method in study.methods if any(record.method == method for record in records)]
    *row_axes, (last, last_values) = study.axes.items()
    rows = sorted({study.place(record.settings)[:-1] for record in records})
    figure, drawn = panels(len(methods) * len(rows), columns=len(methods), size=(2.0, 2.1))
    colors = colormaps["viridis"](np.linspace(0.0, 0.85, len(last_values)))
    for number, panel in enumerate(drawn):
        row, method = rows[number // len(methods)], methods[number % len(methods)]
        for place, value in enumerate(last_values):
            chosen = [
                record for record in records if record.method == method and study.place(record.settings) == (*row, place)
            ]
            if chosen and len(grid) > 0:
                look = dict(color=colors[place], linestyle=LINE_STYLES[place % len(LINE_STYLES)])
                look["marker"] = MARKERS[place % len(MARKERS)]
                lines = curves(chosen, floor, grid)
                draw_line(panel, grid, interquartile_mean(lines[None])[0], value_in_words(value), look)
                seeds = [np.column_stack([grid, line]) for line in lines]
                panel.add_collection(LineCollection(seeds, colors=[colors[place]], linewidths=0.6, alpha=SEED["alpha"]))
        if number < len(methods):
            panel.set_title(method)
        if number % len(methods) == 0:
            names = [
                f"{axis_in_words(axis)} {value_in_words(values[at])}" for (axis, values), at in zip(row_axes, row, strict=True)
            ]
            panel.set_ylabel("\n".join([*names, "return"]))
    count_steps(drawn)
    legend(figure, drawn, f"{task}: {axis_in_words(last)}")
    return png(figure)


@styled
def values(study: Study, table: pd.DataFrame, task: str, repetitions: int) -> bytes:
    """
    Draw a task's final returns against each axis: interquartile means over all runs with a value, with 95 % intervals.

    :param study: the study, with an axis
    :param table: its runs' scores
    :param task: the task
    :param repetitions: number of bootstrap samples
    :return: the picture, as PNG
    """
    figure, grid = panels(len(study.axes), size=(3.7, 2.9))
    looks = styles(study.methods)
    for (axis, axis_values), panel in zip(study.axes.items(), grid, strict=True):
        for number, (method, look) in enumerate(looks.items()):
            # Beside each other, so that no interval hides another
            shift = min(0.1, 0.6 / len(looks)) * (number - (len(looks) - 1) / 2)
            chosen = table[(table["task"] == task) & (table["method"] == method)]
            places, middles, intervals = [], [], []
            for place, value in enumerate(axis_values):
                runs = chosen[[settings.get(axis) == value for settings in chosen["values"]]]
                if len(runs) > 0:
                    found = estimate(interquartile_mean, [cells_of(runs, "score")], repetitions)
                    places.append(place + shift)
                    middles.append(found.value)
                    intervals.append(found.interval or (found.value, found.value))
            if places:
                # A percentile interval need not hold the estimate
                lengths = np.abs(np.clip(np.array(middles)[:, None] - np.array(intervals), [0, -np.inf], [np.inf, 0])).T
                panel.errorbar(places, middles, lengths, label=method, **look, markersize=5, linewidth=1.2, capsize=2)
        panel.set_xticks(range(len(axis_values)), [value_in_words(value) for value in axis_values])
        panel.set(xlabel=axis_in_words(axis))
    grid[0].set_ylabel("final return")
    legend(figure, grid, task)
    return png(figure)


@styled
def final_rewards(study: Study, table: pd.DataFrame, repetitions: int) -> bytes:
    """
    Draw the final returns of a study without axes: each run's, and their interquartile mean with its 95 % interval.

    :param study: the study
    :param table: its runs' scores
    :param repetitions: number of bootstrap samples
    :return: the picture, as PNG
    """
    tasks = list(dict.fromkeys(table["task"]))
    methods = [method for method in study.methods if method != RANDOM] or study.methods
    figure, grid = panels(len(tasks), share=True, size=(3.7, 0.9 + 0.3 * len(methods)))
    for task, panel in zip(tasks, grid, strict=True):
        for place, (method, look) in enumerate(styles(methods).items()):
            runs = table[(table["task"] == task) & (table["method"] == method)]
            if runs.empty:
                continue
            found = estimate(interquartile_mean, [cells_of(runs, "score")], repetitions)
            panel.plot(runs["score"], [place + 0.3] * len(runs), "|", color=look["color"], markersize=8)
            panel.plot(found.value, place, marker=look["marker"], color=look["color"], markersize=7)
            if found.interval is not None:
                panel.plot(found.interval, [place, place], color=look["color"], linewidth=2.5, alpha=0.5)
        panel.set_yticks(range(len(methods)), methods)
        panel.set(title=task, xlabel="final return")
    grid[0].invert_yaxis()
    return png(figure)
