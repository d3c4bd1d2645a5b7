"""The page and the figure of the bias of critics' values."""

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes

from benchmark.common.canvas import count_steps, draw_line, draw_seeds, label_ends, panels, png, styled
from benchmark.common.provenance import conditions_in_words
from benchmark.common.style import styles
from benchmark.common.tables import markdown_table
from benchmark.values.episodes import TAIL, horizon
from benchmark.values.methods import EXPLORATION_NOISE, LEARNING_RATE, MAIN, VARIANTS

Point = dict[str, Any]
Value = Callable[[Point], float | None]
# The methods that share a row of panels
ROWS = (
    [method for method in MAIN if method.removeprefix("CGP-").isdecimal()],
    ["CGP-2", "CGP-Light", "TD3"],
    ["CGP-2", *list(VARIANTS)[:2]],
    ["CGP-2", *list(VARIANTS)[2:]],
)
FIGURE = """\
![The bias of the critics' values, and the return of the actor](bias.png)

*The bias (left) and the return of the actor (right) by environment steps: every seed (thin), and the mean over the seeds
(bold). The names at the right end are those of the whole row.*"""

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


def cell(runs: Iterable[dict[str, Any]], policy: str, value: Value) -> str:
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
    bounds = [
        point[policy]["error_bound"]
        for record in records
        for point in late(record)
        for policy in ("actor", "cem")
        if policy in point
    ]
    notes = NOTES.format(
        **settings,
        horizon=horizon(settings["gamma"]),
        n_points=len(late(records[0])),
        error_bound=max((bound for bound in bounds if bound is not None), default=0.0),
    )
    conditions = f"The first run: {conditions_in_words(records[0])}"
    parts = ["# The bias of the critics' values", markdown_table(header, rows), FIGURE, notes, conditions]
    return "\n\n".join(parts) + "\n"


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


@styled
def draw(records: list[dict[str, Any]]) -> bytes:
    """
    Draw the bias, and the actor's return, by environment steps: every seed, and the mean over seeds.

    :param records: the runs, with the same settings
    :return: the picture, as PNG: a row for each group of methods
    """
    run = {record["method"] for record in records}
    rows = [[method for method in row if method in run] for row in ROWS]
    rows = [row for row in rows if row]
    figure, grid = panels(2 * len(rows), share=False, columns=2, size=(3.6, 2.0))
    for row, left, right in zip(rows, grid[::2], grid[1::2], strict=True):
        left.sharey(grid[0])
        right.sharey(grid[1])
        _draw_panel(left, records, row, first_bias)
        _draw_panel(right, records, row, lambda measured: measured["return"])
        left.axhline(0.0, color="black", linewidth=0.8)
        left.set_ylabel("bias")
        right.set_ylabel("return")
    count_steps(grid)
    chosen = looks(list(run))
    for row, right in zip(rows, grid[1::2], strict=True):
        ends = {method: _means(records, method, lambda measured: measured["return"])[1] for method in row}
        label_ends(right, {method: (float(line[-1]), chosen[method]["color"]) for method, line in ends.items() if len(line)})
    return png(figure)


def _means(records: list[dict[str, Any]], method: str, value: Value) -> tuple[list[int], np.ndarray, np.ndarray]:
    """Return the steps (E) of a method's measurements, the means over seeds (E), and each seed's values (N, E)."""
    runs = [record for record in records if record["method"] == method]
    steps = [point["steps"] for point in runs[0]["points"]]
    lines = np.array([[value(point["actor"]) for point in run["points"]] for run in runs], dtype=float)
    return steps, lines.mean(axis=0), lines


def _draw_panel(panel: Axes, records: list[dict[str, Any]], methods: list[str], value: Value) -> None:
    """Draw each seed, and a line of means over seeds, for each method."""
    for method, look in looks(methods).items():
        steps, means, lines = _means(records, method, value)
        if steps:
            draw_seeds(panel, np.array(steps), lines, look["color"])
            draw_line(panel, np.array(steps), means, method, look)
