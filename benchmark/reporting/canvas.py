"""What all figures share: panels, legends, lines with markers, and pictures as PNG."""

import functools
import io
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator

PANEL = (3.6, 2.9)
# Letters that can be read when the picture is half a page wide
LOOK: dict[Any, Any] = {
    "font.size": 12.0,
    "axes.titlesize": 12.0,
    "legend.fontsize": 11.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
}
# Markers on a line, so that it is told from others without its colour
MARKS = 6
SEED: dict[str, Any] = dict(linewidth=0.8, alpha=0.35)
BAND: dict[str, Any] = dict(alpha=0.18, linewidth=0)

Drawn = TypeVar("Drawn", bound=Callable[..., bytes])


def styled(draw: Drawn) -> Drawn:
    """
    Let a function draw in the style of this project, and leave Matplotlib's settings as they were.

    :param draw: the function
    :return: the function in this style
    """

    @functools.wraps(draw)
    def wrapped(*args: Any, **kwargs: Any) -> bytes:
        with rc_context(LOOK):
            return draw(*args, **kwargs)

    return wrapped  # type: ignore[return-value]


def png(figure: Figure) -> bytes:
    """
    Save a figure.

    :param figure: the figure
    :return: the picture, the same for the same figure, in the colours that it was drawn in
    """
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=110, pil_kwargs={"optimize": True})
    return picture.getvalue()


def panels(
    number: int, share: bool = True, columns: int | None = None, size: tuple[float, float] = PANEL
) -> tuple[Figure, list[Axes]]:
    """
    Lay out panels beside each other, and in rows.

    :param number: how many
    :param share: whether all have the same vertical axis
    :param columns: how many beside each other; None takes up to two or three, whichever fills the rows
    :param size: width and height of a panel, inches
    :return: the figure, and its panels
    """
    columns = columns or (3 if number == 3 or number > 4 else min(number, 2))
    rows = -(-number // columns)
    # No pyplot: its global figure list and its choice of a screen back-end are of no use here
    figure = Figure(figsize=(size[0] * columns, size[1] * rows + 0.6), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False, sharey=share).ravel()
    for axes in grid[number:]:
        axes.remove()
    for place, axes in enumerate(grid[:number]):
        axes.grid(alpha=0.3)
        axes.tick_params(labelleft=not share or place % columns == 0)
        axes.xaxis.set_major_locator(MaxNLocator(4))
        axes.yaxis.set_major_locator(MaxNLocator(6))
    return figure, list(grid[:number])


def legend(figure: Figure, panel: Sequence[Axes], title: str | None = None) -> None:
    """
    Write one legend above all panels.

    :param figure: the figure
    :param panel: its panels
    :param title: title of the legend
    """
    entries = {label: handle for axes in panel for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    # Inches, at the size of letters above
    widest = 0.95 + 0.105 * max(map(len, entries), default=0)
    columns = max(min(len(entries), int(figure.get_figwidth() / widest)), 1)
    look: dict[str, Any] = dict(loc="outside upper center", ncols=columns, frameon=False, handlelength=2.6, columnspacing=1.4)
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
    panel.plot(x, y, label=label, **look, drawstyle=drawstyle, markevery=every, markersize=5, linewidth=1.8)


def label_steps(panel: Axes) -> None:
    """
    Label the horizontal axis with environment steps.

    :param panel: the panel
    """
    panel.set_xlabel("environment steps")
    panel.xaxis.set_major_formatter(EngFormatter(sep=""))
