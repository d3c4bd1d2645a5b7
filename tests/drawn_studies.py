"""Studies of runs that took so long, and what is drawn of them."""

from dataclasses import replace

from finished_studies import record
from matplotlib.axes import Axes

from benchmark.common.records import Record


def timed(method: str, seed: int, minutes: float | None, **options: object) -> Record:
    """A run of 1,000 steps, evaluated every 250, that took so long."""
    run = record(method, seed, 40.0, returns=[10.0, 20.0, 30.0, 40.0], **options)  # type: ignore[arg-type]
    return replace(run, processor_seconds=None if minutes is None else 60 * minutes)


def lines(panel: Axes) -> dict[str, tuple[list[float], list[float]]]:
    """Return the points of each line in the legend by its label."""
    labelled = [line for line in panel.get_lines() if not str(line.get_label()).startswith("_")]
    return {str(line.get_label()): (list(line.get_xdata()), list(line.get_ydata())) for line in labelled}
