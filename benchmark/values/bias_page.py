"""The page and the figure of the bias of critics' values."""

import io
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from benchmark.common.provenance import conditions_in_words
from benchmark.common.style import styles
from benchmark.common.tables import markdown_table
from benchmark.values.episodes import TAIL, horizon
from benchmark.values.methods import EXPLORATION_NOISE, LEARNING_RATE, MAIN, VARIANTS

Point = dict[str, Any]

NOTES = f"""\
Bias: the first critic's value Q_1 of a state and of the action taken in it, less the discounted return that followed.
Averaged over the states of {{episodes}} episodes of the actor, and over the {{n_points}} measurements in the second
half of {{steps:,}} steps on {{env}}. Shown are the mean over the seeds, and the lowest and the highest seed's. Bias of
the minimum: with the minimum of both critics in place of Q_1. Return: of the whole episodes, not discounted. CEM: in
episodes in which CEM acts by the first critic, as it does in the training's rollouts, since CGP's critics learn the
values of CEM's actions, not of the actor's.

The episodes begin in the same states at each measurement, and a time limit truncates them after {{episode_steps:,}}
steps. After a termination no reward follows, so that all states count. Of a truncated episode, those states count that
at least {{horizon}} steps follow, as γ^{{horizon}} < {TAIL}. If later rewards are not larger than the largest in the
episode, the rewards that are cut off change no bias by more than {{error_bound:.2g}} (0 if no episode was truncated).

All methods: γ = {{gamma}}, τ = {{tau}}, batch size {{batch_size}}, two hidden layers of {{units}} units, learning rate
{LEARNING_RATE}, {{learning_starts:,}} random steps. CGP-n: the paper's CEM, with n iterations of 64 samples. CGP-Light:
`cem_start="actor"`, one iteration of 16 samples. TD3: SB3's, with exploration noise {EXPLORATION_NOISE}. The others are
variants of CGP-2. floor: the bootstrap value is at least the minimum of the target critics for the averaged actor's
action. clamp: it is clamped to the range of all targets so far, as in TD7. min: CEM ranks actions by the minimum of
both critics. mean: CEM returns the elites' mean."""


def first_bias(measured: Point) -> float | None:
    """
    Return the bias of the first critic.

    :param measured: the means of a measurement of one policy
    :return: the bias; None if no state counted
    """
    return None if measured["q1"] is None else measured["q1"] - measured["discounted_return"]


def least_bias(measured: Point) -> float | None:
    """
    Return the bias of the minimum of both critics.

    :param measured: the means of a measurement of one policy
    :return: the bias; None if no state counted
    """
    return None if measured["q_min"] is None else measured["q_min"] - measured["discounted_return"]


def late(run: dict[str, Any]) -> list[Point]:
    """
    Return the measurements in the second half of a training.

    :param run: its record
    :return: the measurements
    """
    return [point for point in run["points"] if 2 * point["steps"] > run["settings"]["steps"]]


def cell(runs: Iterable[dict[str, Any]], policy: str, value: Callable[[Point], float | None]) -> str:
    """
    Return a cell of the table: the mean of the seeds' means, and their range.

    :param runs: a method's records
    :param policy: "actor" or "cem"
    :param value: the value of a measurement
    :return: the cell; "-" where nothing was measured
    """
    means = []
    for run in runs:
        values = [value(point[policy]) for point in late(run) if policy in point]
        known = [each for each in values if each is not None]
        if known:
            means.append(np.mean(known))
    if not means:
        return "-"
    low, high = (f"{bound:.1f}" for bound in (min(means), max(means)))
    return f"{np.mean(means):.1f} ({low} to {high})"


def markdown(records: list[dict[str, Any]]) -> str:
    """
    Write the table of all methods.

    :param records: the runs, with the same settings
    :return: the page in Markdown
    """
    methods = list(dict.fromkeys(record["method"] for record in records))
    header = [
        "method",
        "seeds",
        "bias",
        "bias of the minimum",
        "Q_1",
        "discounted return",
        "return",
        "CEM: bias",
        "CEM: return",
    ]
    rows = []
    for method in methods:
        runs = [record for record in records if record["method"] == method]
        rows.append(
            [
                method,
                ", ".join(str(run["seed"]) for run in runs),
                cell(runs, "actor", first_bias),
                cell(runs, "actor", least_bias),
                cell(runs, "actor", lambda measured: measured["q1"]),
                cell(runs, "actor", lambda measured: measured["discounted_return"]),
                cell(runs, "actor", lambda measured: measured["return"]),
                cell(runs, "cem", first_bias),
                cell(runs, "cem", lambda measured: measured["return"]),
            ]
        )
    settings = records[0]["settings"]
    bounds = [point["actor"]["error_bound"] for record in records for point in late(record)]
    notes = NOTES.format(
        **settings,
        horizon=horizon(settings["gamma"]),
        n_points=len(late(records[0])),
        error_bound=max((bound for bound in bounds if bound is not None), default=0.0),
    )
    conditions = f"The first run: {conditions_in_words(records[0])}"
    return "\n\n".join(["# The bias of the critics' values", markdown_table(header, rows), notes, conditions]) + "\n"


def looks(methods: Iterable[str]) -> dict[str, dict[str, Any]]:
    """
    Return the style of each method.

    :param methods: the methods
    :return: Matplotlib's colour, line style and marker, by method: shades for CGP by its iterations, and own colours for
        its variants
    """
    chosen = styles(methods)
    numbered = [method for method in MAIN if method.removeprefix("CGP-").isdecimal()]
    shades = dict(zip(numbered, colormaps["viridis"](np.linspace(0.85, 0.1, len(numbered))), strict=True))
    colors = dict(zip(VARIANTS, colormaps["Dark2"](range(1, len(VARIANTS) + 1)), strict=True))
    for method, look in chosen.items():
        if method in shades:
            chosen[method] = look | dict(color=shades[method], linestyle="-", marker="o")
        elif method in colors:
            chosen[method] = look | dict(color=colors[method])
    return chosen


def draw(records: list[dict[str, Any]]) -> bytes:
    """
    Draw the bias, and the actor's return, by environment steps: means over seeds, and their ranges.

    :param records: the runs, with the same settings
    :return: the picture, as PNG: a row for the methods, and a row for the variants of CGP-2
    """
    # No pyplot: its global figure list and its choice of a screen back-end are of no use here
    figure = Figure(figsize=(9.5, 7.0), layout="constrained")
    grid = figure.subplots(2, 2, sharex=True)
    rows = ("methods", list(MAIN)), ("variants of CGP-2", ["CGP-2", *VARIANTS])
    for (left, right), (title, methods) in zip(grid, rows, strict=True):
        _draw_panel(left, records, methods, first_bias)
        _draw_panel(right, records, methods, lambda measured: measured["return"])
        left.axhline(0.0, color="black", linewidth=0.8)
        left.set(title=f"{title}: bias", ylabel="value less discounted return")
        right.set(title=f"{title}: return", ylabel="return of the actor")
        if any(record["method"] in methods for record in records):
            left.legend(fontsize="small", frameon=False)
    for axes in grid[1]:
        axes.set_xlabel("environment steps")
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=120)
    return picture.getvalue()


def _draw_panel(axes: Axes, records: list[dict[str, Any]], methods: list[str], value: Callable[[Point], float | None]) -> None:
    """Draw a line of means over seeds, and a band of their range, for each method."""
    for method, look in looks(methods).items():
        runs = [record for record in records if record["method"] == method]
        if not runs or not runs[0]["points"]:
            continue
        steps = [point["steps"] for point in runs[0]["points"]]
        lines = np.array([[value(point["actor"]) for point in run["points"]] for run in runs], dtype=float)
        axes.plot(steps, lines.mean(axis=0), label=method, markersize=4, linewidth=1.4, **look)
        axes.fill_between(steps, lines.min(axis=0), lines.max(axis=0), color=look["color"], alpha=0.12, linewidth=0)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.grid(alpha=0.3)
