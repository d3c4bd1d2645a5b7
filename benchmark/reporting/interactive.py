"""Learning curves that a reader explores in a browser: figures of plotly.js, as plain data."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmark.common.records import Record
from benchmark.common.style import styles
from benchmark.reporting.estimates import REPETITIONS, bootstrap, interquartile_mean
from benchmark.reporting.learning_curves import (
    MAX_CURVES_PER_PANEL,
    Times,
    first_training_step,
    learnt_range,
    shown_methods,
    times_of,
)
from benchmark.reporting.literature import published
from benchmark.reporting.scores import Study, curves, evaluation_grid, floors
from benchmark.reporting.verdicts import SHOWN_FIRST

Trace = dict[str, Any]

# Matplotlib's markers and line styles in plotly.js
SYMBOLS = {"o": "circle", "s": "square", "D": "diamond", "v": "triangle-down", "^": "triangle-up", "P": "cross", "X": "x"}
DASHES = {"-": "solid", "--": "dash", "-.": "dashdot", ":": "dot"}
STEPS, MINUTES = "environment steps", "minutes of processor time"


def figure(study: Study, task: str, repetitions: int = REPETITIONS) -> dict[str, Any]:
    """
    Return the learning curves of all methods on a task: every seed, the interquartile mean, its 95 % interval, and published
    returns. A click on a method in the legend hides it; buttons change between steps and minutes, and hide the seeds.

    :param study: the study, without axes
    :param task: the task
    :param repetitions: number of bootstrap samples
    :return: ``data`` and ``layout`` of plotly.js
    """
    times = times_of(study, task)
    data: list[Trace] = []
    methods = shown_methods(study, task)
    # The others wait in the legend, so that the figure can be read
    first = [method for method in SHOWN_FIRST if method in methods] or methods[:MAX_CURVES_PER_PANEL]
    for method in methods:
        runs = [record for record in study.records if (record.task, record.method) == (task, method)]
        visible = True if len(methods) <= MAX_CURVES_PER_PANEL or method in first else "legendonly"
        traces = _method(study, runs, times, repetitions)
        data += [trace | {"visible": visible} for trace in traces]
    data += [_literature(entry) for entry in published(task, study.facts["steps"])]
    buttons = [_button(data, "by steps", "x", STEPS)]
    if times.runs:
        unit = MINUTES if len(times.processors) < 2 else f"{MINUTES}, on different machines"
        buttons.append(_button(data, "by minutes", "minutes", unit))
    seeds = [number for number, trace in enumerate(data) if trace["meta"]["kind"] == "seed"]
    thin = [
        {"label": label, "method": "restyle", "args": [{"opacity": opacity}, seeds]}
        for label, opacity in (("seeds", 0.4), ("no seeds", 0.0))
    ]
    menus = [_menu(buttons, "left"), _menu(thin, "right")]
    layout = {
        "xaxis": {"title": {"text": STEPS}, "rangemode": "tozero"},
        "yaxis": {"title": {"text": "return"}, **_vertical(study, task)},
        "legend": {"groupclick": "togglegroup", "orientation": "h", "y": -0.25},
        "updatemenus": menus,
        "margin": {"t": 60, "r": 10, "l": 60, "b": 40},
        "hovermode": "closest",
        "height": 520,
    }
    for trace in data:
        trace.pop("minutes", None)
    return {"data": data, "layout": layout}


def _method(study: Study, runs: Sequence[Record], times: Times, repetitions: int) -> list[Trace]:
    """Return the traces of a method; those of runs without a time have no points by minutes."""
    method, task = runs[0].method, runs[0].task
    timed = {record.key for record in times.runs}
    (look,) = styles([method]).values()
    floor, grid = floors(study.records)[task], evaluation_grid(study.records, task)
    lines = curves(runs, floor, grid)
    name = study.label(method, len(runs))

    def trace(kind: str, y: np.ndarray, is_timed: bool, **options: Any) -> Trace:
        minutes = times.minutes(method, grid) if method in times.minutes_per_step and is_timed else np.array([])
        points = {"x": _rounded(grid), "y": _rounded(y), "minutes": _rounded(minutes)}
        return (
            {"type": "scatter", "mode": "lines", "name": name, "legendgroup": method, "meta": {"kind": kind}}
            | points
            | options
        )

    color = look["color"]
    traces = []
    middle, interval = bootstrap(interquartile_mean, [{"": lines}], repetitions)
    if interval is not None:
        hidden = {"line": {"width": 0}, "showlegend": False, "hoverinfo": "skip"}
        traces.append(trace("band", interval[0], True, **hidden))
        traces.append(trace("band", interval[1], True, **hidden, fill="tonexty", fillcolor=_faint(color)))
    for record, line in zip(runs, lines, strict=True):
        thin = {"line": {"color": color, "width": 1}, "opacity": 0.4, "showlegend": False}
        hover = f"{method}, seed {record.seed}: %{{y:.4g}}<extra></extra>"
        traces.append(trace("seed", line, record.key in timed, **thin, hovertemplate=hover))
    bold = {"color": color, "width": 2.5, "dash": DASHES.get(str(look["linestyle"]), "longdash")}
    marker = {"symbol": SYMBOLS.get(look["marker"], "circle"), "size": 7, "maxdisplayed": 8}
    return [*traces, trace("mean", middle, True, mode="lines+markers", line=bold, marker=marker)]


def _literature(entry: Any) -> Trace:
    (look,) = styles([entry.method]).values()
    symbol = SYMBOLS.get(look["marker"], "circle") + "-open"
    return {
        "type": "scatter",
        "mode": "markers",
        "name": f"{entry.method} in the literature, {entry.task}-{entry.version}, not measured here",
        "meta": {"kind": "literature"},
        "x": list(entry.returns),
        "y": [mean for mean, _ in entry.returns.values()],
        # Their authors published no times
        "minutes": [],
        "marker": {"symbol": symbol, "size": 12, "color": look["color"], "line": {"width": 2}},
        "hovertemplate": f"{entry.method}, {entry.seeds} seeds: {entry.source}: %{{y}}<extra></extra>",
    }


def _button(data: Sequence[Trace], label: str, key: str, title: str) -> dict[str, Any]:
    places = {"x": [trace[key] for trace in data]}
    return {"label": label, "method": "update", "args": [places, {"xaxis.title.text": title, "xaxis.autorange": True}]}


def _menu(buttons: list[dict[str, Any]], side: str) -> dict[str, Any]:
    where = {"x": float(side == "right"), "xanchor": side, "y": 1.0, "yanchor": "bottom", "pad": {"b": 8}}
    return {"type": "buttons", "direction": "right", "active": 0, "showactive": True, "buttons": buttons} | where


def _vertical(study: Study, task: str) -> dict[str, Any]:
    """Return the range of the vertical axis, that of the pictures; a double click shows all."""
    first, shown = first_training_step(study), shown_methods(study, task)
    returns = [
        value
        for record in study.records
        if record.task == task and record.method in shown
        for step, value in zip(record.timesteps, record.returns, strict=True)
        if step > first and np.isfinite(value)
    ]
    anchors = [mean for entry in published(task, study.facts["steps"]) for mean, _ in entry.returns.values()]
    return {"range": list(learnt_range(np.array(returns + anchors)))} if returns else {}


def _rounded(values: np.ndarray) -> list[float]:
    """Return numbers of five digits, which a screen does not tell from the exact ones."""
    return [float(f"{value:.5g}") for value in values]


def _faint(color: str) -> str:
    red, green, blue = (int(color[place : place + 2], 16) for place in (1, 3, 5))
    return f"rgba({red}, {green}, {blue}, 0.15)"
