"""The figure of a population's speed: agent-steps per second by the number of agents, measured and estimated."""

import io
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmark.common.style import styles
from benchmark.speed.card_estimates import GRAPH, NO_GRAPH

STYLED = {"CGP-2": "CGP-Online", "CGP-4": "CGP-Offline"}


def draw(record: dict[str, Any]) -> bytes:
    """
    Draw the speeds, on logarithmic scales.

    :param record: measurements and estimates
    :return: the picture, as PNG
    """
    measured = [point for point in record["points"] if point["n_agents"] > 0]
    panels: list[tuple[str, list[dict[str, Any]], str | None]] = []
    if measured:
        place = record["machine"]["gpu"] or record["machine"]["cpu"]
        panels.append((f"measured: {place}", measured, None))
    if record.get("estimates"):
        card = record["estimates"]["card"]["name"]
        panels += [(f"ESTIMATE: {card},\n{mode}", record["estimates"]["points"], mode) for mode in (GRAPH, NO_GRAPH)]
    # No pyplot: its global figure list and its choice of a screen back-end are of no use here
    figure = Figure(figsize=(4.2 * max(len(panels), 1), 3.8), layout="constrained")
    for number, (title, points, mode) in enumerate(panels, start=1):
        axes = figure.add_subplot(1, len(panels), number)
        _draw_panel(axes, points, mode)
        axes.set_title(title, fontsize="small")
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=150)
    return picture.getvalue()


def _draw_panel(axes: Axes, points: list[dict[str, Any]], mode: str | None) -> None:
    """Draw each method's line: medians and quartiles where measured, dashed lines where estimated."""
    methods = list(dict.fromkeys(point["method"] for point in points))
    looks = styles(STYLED.get(method, method) for method in methods)
    for method in methods:
        own = sorted((point for point in points if point["method"] == method), key=lambda point: point["n_agents"])
        numbers = [point["n_agents"] for point in own]
        look = looks[STYLED.get(method, method)]
        if mode is None:
            speeds = [point["agent_steps_per_second"] for point in own]
            axes.plot(numbers, [speed["median"] for speed in speeds], label=method, **look)
            lower, upper = ([speed[key] for speed in speeds] for key in ("lower", "upper"))
            axes.fill_between(numbers, lower, upper, color=look["color"], alpha=0.2, linewidth=0)
        else:
            speeds = [point["agent_steps_per_second"][mode] for point in own]
            axes.plot(numbers, speeds, label=method, **(look | {"linestyle": ":"}))
    numbers = sorted({point["n_agents"] for point in points})
    axes.set(xscale="log", yscale="log", xlabel="agents", ylabel="agent-steps per second")
    axes.set_xticks(numbers, [str(number) for number in numbers])
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
