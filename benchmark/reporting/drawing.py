"""The figures of a study: stability, sensitivity to each axis, final rewards."""

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator
from PIL import Image

from benchmark.common.style import styles
from benchmark.reporting.estimates import (
    REPETITIONS,
    bootstrap,
    cells_of,
    estimate,
    interquartile_mean,
    share_reaching,
)
from benchmark.reporting.scores import Study, axis_in_words, curves, evaluation_grid, floors, value_in_words

PANEL = (4.0, 3.2)
LINE_STYLES: list[Any] = ["-", "--", "-.", ":", (0, (4, 1, 1, 1, 1, 1)), (0, (8, 2))]
MARKERS = "osD^vXP"
# Markers on a line, so that it is told from others without its colour
MARKS = 8


def png(figure: Figure) -> bytes:
    """
    Save a figure.

    :param figure: the figure
    :return: the picture, the same for the same figure, in few colours and so in few bytes
    """
    drawn, picture = io.BytesIO(), io.BytesIO()
    figure.savefig(drawn, format="png", dpi=120)
    Image.open(drawn).convert("RGB").quantize(128, dither=Image.Dither.NONE).save(picture, format="png", optimize=True)
    return picture.getvalue()


def panels(number: int, share: bool = True, columns: int | None = None) -> tuple[Figure, list[Axes]]:
    """
    Lay out panels beside each other, and in rows.

    :param number: how many
    :param share: whether all have the same vertical axis
    :param columns: how many beside each other; None takes up to two or three, whichever fills the rows
    :return: the figure, and its panels
    """
    columns = columns or (3 if number == 3 or number > 4 else min(number, 2))
    rows = -(-number // columns)
    # No pyplot: its global figure list and its choice of a screen back-end are of no use here
    figure = Figure(figsize=(PANEL[0] * columns, PANEL[1] * rows + 0.7), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False, sharey=share).ravel()
    for axes in grid[number:]:
        axes.remove()
    for axes in grid[:number]:
        axes.grid(alpha=0.3)
        axes.tick_params(labelleft=True)
        axes.xaxis.set_major_locator(MaxNLocator(5))
    return figure, list(grid[:number])


def legend(figure: Figure, panel: Sequence[Axes], title: str | None = None) -> None:
    """
    Write one legend above all panels.

    :param figure: the figure
    :param panel: its panels
    :param title: title of the legend
    """
    entries = {label: handle for axes in panel for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    # An entry is about as wide as half a panel, and wider with a long label; inches, at the usual size of letters
    widest = max(PANEL[0] / 2.3, 0.85 + 0.085 * max(map(len, entries), default=0))
    columns = max(min(len(entries), int(figure.get_figwidth() / widest)), 1)
    look: dict[str, Any] = dict(loc="outside upper center", ncols=columns, frameon=False, handlelength=3.2)
    figure.legend(list(entries.values()), list(entries), title=title, **look)


def draw_line(panel: Axes, x: np.ndarray, y: np.ndarray, label: str, look: dict[str, Any], drawstyle: Any = None) -> None:
    """
    Draw a line with a few markers.

    :param panel: the panel
    :param x: abscissae (E)
    :param y: ordinates (E)
    :param label: the line's name in the legend
    :param look: Matplotlib's colour, line style and marker
    :param drawstyle: Matplotlib's drawing style, such as "steps-pre"; None for straight lines between points
    """
    every = max(1, len(x) // MARKS)
    panel.plot(x, y, label=label, **look, drawstyle=drawstyle, markevery=every, markersize=4, linewidth=1.4)


def label_steps(panel: Axes) -> None:
    """
    Label the horizontal axis with environment steps.

    :param panel: the panel
    """
    panel.set_xlabel("environment steps")
    panel.xaxis.set_major_formatter(EngFormatter(sep=""))


def stability(table: pd.DataFrame, methods: Sequence[str], repetitions: int = REPETITIONS) -> bytes:
    """
    Draw the share of runs that reach at least a reward, with its 95 % band: of all runs, and closer of the better half.

    :param table: the runs' scores
    :param methods: the methods, in the legend's order
    :param repetitions: number of bootstrap samples
    :return: the picture, as PNG
    """
    tasks = list(dict.fromkeys(table["task"]))
    # A task's two panels stand beside each other
    figure, grid = panels(2 * len(tasks), columns=2)
    for task, whole, closer in zip(tasks, grid[::2], grid[1::2], strict=True):
        runs = table[table["task"] == task]
        levels = np.unique(runs["score"])
        for method, look in styles(methods).items():
            cells = cells_of(runs[runs["method"] == method], "score")
            if not cells:
                continue
            share, band = bootstrap(lambda scores, levels=levels: share_reaching(scores, levels), [cells], repetitions)
            for axes in (whole, closer):
                draw_line(axes, levels, 100 * share, method, look, drawstyle="steps-pre")
                if band is not None:
                    axes.fill_between(
                        levels, 100 * band[0], 100 * band[1], step="pre", color=look["color"], alpha=0.12, linewidth=0
                    )
        whole.set(title=f"{task}: all runs", xlabel="final reward", ylabel="runs that reach it, %", ylim=(-3, 103))
        median = float(runs["score"].median())
        margin = 0.03 * (levels[-1] - median) or 1.0
        closer.set(title="the range of the better half", xlabel="final reward", xlim=(median - margin, levels[-1] + margin))
    legend(figure, grid)
    return png(figure)


def _looks(study: Study) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """List the configurations that were run with a look: colour and marker by the first axis, line by all others."""
    places = sorted({study.place(record.settings): record.settings for record in study.records}.items())
    rests = list(dict.fromkeys(numbers[1:] for numbers, _ in places))
    colors = colormaps["viridis"](np.linspace(0.0, 0.8, len(next(iter(study.axes.values())))))
    looks = []
    for numbers, settings in places:
        line = rests.index(numbers[1:]) if len(study.axes) > 1 else numbers[0]
        look = dict(color=colors[numbers[0]], marker=MARKERS[numbers[0] % len(MARKERS)])
        looks.append((settings, look | dict(linestyle=LINE_STYLES[line % len(LINE_STYLES)])))
    return looks


def sensitivity(study: Study, task: str) -> bytes:
    """
    Draw a task's learning curves for each configuration: a panel per method, a line per configuration, means over seeds.

    :param study: the study, with an axis
    :param task: the task
    :return: the picture, as PNG
    """
    floor, grid = floors(study.records)[task], evaluation_grid(study.records, task)
    ran = {record.method for record in study.records if record.task == task}
    methods = [method for method in study.methods if method in ran]
    figure, drawn = panels(len(methods))
    for method, panel in zip(methods, drawn, strict=True):
        for settings, look in _looks(study):
            records = [
                record for record in study.records if (record.method, record.task, record.settings) == (method, task, settings)
            ]
            if records and len(grid) > 0:
                label = " / ".join(value_in_words(value) for value in settings.values())
                draw_line(panel, grid, curves(records, floor, grid).mean(axis=0), label, look)
        panel.set(title=method, ylabel="return")
        label_steps(panel)
    legend(figure, drawn, f"{task}: {' / '.join(axis_in_words(axis) for axis in study.axes)}")
    return png(figure)


def values(study: Study, table: pd.DataFrame, task: str, repetitions: int = REPETITIONS) -> bytes:
    """
    Draw a task's final rewards against each axis: interquartile means over all runs with a value, with 95 % intervals.

    :param study: the study, with an axis
    :param table: its runs' scores
    :param task: the task
    :param repetitions: number of bootstrap samples
    :return: the picture, as PNG
    """
    figure, grid = panels(len(study.axes))
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
    grid[0].set_ylabel("final reward")
    legend(figure, grid, task)
    return png(figure)


def final_rewards(study: Study, table: pd.DataFrame, repetitions: int = REPETITIONS) -> bytes:
    """
    Draw the final rewards of a study without axes: each run's, and their interquartile mean with its 95 % interval.

    :param study: the study
    :param table: its runs' scores
    :param repetitions: number of bootstrap samples
    :return: the picture, as PNG
    """
    tasks = list(dict.fromkeys(table["task"]))
    figure, grid = panels(len(tasks))
    for task, panel in zip(tasks, grid, strict=True):
        for place, (method, look) in enumerate(styles(study.methods).items()):
            runs = table[(table["task"] == task) & (table["method"] == method)]
            if runs.empty:
                continue
            found = estimate(interquartile_mean, [cells_of(runs, "score")], repetitions)
            panel.plot(runs["score"], [place + 0.3] * len(runs), "|", color=look["color"], markersize=6)
            panel.plot(found.value, place, marker=look["marker"], color=look["color"], markersize=6)
            if found.interval is not None:
                panel.plot(found.interval, [place, place], color=look["color"], linewidth=2.5, alpha=0.5)
        panel.set_yticks(range(len(study.methods)), study.methods)
        panel.set(title=task, xlabel="final reward")
    grid[0].invert_yaxis()
    return png(figure)
