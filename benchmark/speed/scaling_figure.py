"""The figure of the cost of training: a panel for each axis and quantity."""

import io
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from benchmark.common.style import METHODS

AXIS_TITLES = {
    "cem_iterations": "CEM iterations",
    "cem_samples": "CEM samples",
    "width": "units per hidden layer",
    "action_dim": "action dimensions",
    "observation_dim": "observation dimensions",
    "n_envs": "parallel environments",
}
# By the name in the points: title of the vertical axis, and the factor to its unit
QUANTITIES = {
    "gradient_step_seconds": ("ms per gradient step", 1e3),
    "env_steps_per_second": ("environment steps per second", 1.0),
}
STYLES = {"CGP": METHODS["CGP-Online"], "TD3": METHODS["TD3"]}
COLUMNS = 4


def panels(points: list[dict[str, Any]]) -> list[tuple[str, str]]:
    """
    Return the panels of the figure.

    :param points: the measurements
    :return: axis and quantity of each panel, in the order in which they were measured
    """
    return [
        (axis, quantity)
        for axis in dict.fromkeys(point["axis"] for point in points)
        for quantity in QUANTITIES
        if any(quantity in point for point in points if point["axis"] == axis)
    ]


def draw(record: dict[str, Any]) -> bytes:
    """
    Draw the measurements, on logarithmic scales.

    :param record: the points and their conditions
    :return: the picture, as PNG
    """
    chosen = panels(record["points"])
    n_rows, n_columns = -(-len(chosen) // COLUMNS), min(len(chosen), COLUMNS)
    # No pyplot: its global figure list and its choice of a screen back-end are of no use here
    figure = Figure(figsize=(3.2 * n_columns, 2.8 * n_rows + 0.6), layout="constrained")
    for number, (axis, quantity) in enumerate(chosen, start=1):
        _draw_panel(figure.add_subplot(n_rows, n_columns, number), record["points"], axis, quantity)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False)
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=150)
    return picture.getvalue()


def _draw_panel(axes: Axes, points: list[dict[str, Any]], axis: str, quantity: str) -> None:
    """Draw medians and quartiles of both algorithms."""
    title, factor = QUANTITIES[quantity]
    for algorithm, style in STYLES.items():
        shown = [point for point in points if (point["axis"], point["algorithm"]) == (axis, algorithm)]
        values = [point["value"] for point in shown]
        median, lower, upper = ([factor * point[quantity][key] for point in shown] for key in ("median", "lower", "upper"))
        axes.plot(values, median, label=algorithm, markersize=5, **style)
        axes.fill_between(values, lower, upper, color=style["color"], alpha=0.2, linewidth=0)
    axes.set(xscale="log", yscale="log", xlabel=AXIS_TITLES[axis], ylabel=title)
    axes.set_xticks(values, [str(value) for value in values])
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.minorticks_off()
    axes.grid(alpha=0.3)
