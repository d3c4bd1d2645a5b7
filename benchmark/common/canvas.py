"""What all figures share: panels, legends, lines with markers, seeds, labels, and pictures as PNG."""

import functools
import io
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator

# Three panels beside each other are 7.5 inches wide, so that these letters can still be read on half a page's width
PANEL = (2.5, 2.2)
LOOK: dict[Any, Any] = {
    "font.size": 12.0,
    "axes.titlesize": 12.0,
    "axes.labelsize": 12.0,
    "legend.fontsize": 11.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    # Names of methods and values are a user's own, and a dollar sign in them is one
    "text.parse_math": False,
}
# How often a figure is enlarged at most, the inches that letters may be beyond its edge, and those between two titles
ENLARGEMENTS, SLACK, TITLE_GAP = 4, 0.03, 0.1
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
    Save a figure. A figure that cuts letters off is enlarged before.

    :param figure: the figure
    :return: the picture, the same for the same figure, in the colours that it was drawn in
    """
    for _ in range(ENLARGEMENTS):
        picture = io.BytesIO()
        figure.savefig(picture, format="png", dpi=120, pil_kwargs={"optimize": True})
        # Measured after the layout, which a draw before would change
        missing = _missing_inches(figure)
        if missing.max() < SLACK:
            break
        figure.set_size_inches(figure.get_size_inches() + missing)
    return picture.getvalue()


def _missing_inches(figure: Figure) -> np.ndarray:
    """Return the width and height that a drawn figure lacks for all letters, those of titles beside each other included."""
    size, drawn = figure.get_size_inches(), figure.get_tightbbox()
    # Centred letters are cut at both ends
    beyond = [max(-drawn.x0, drawn.x1 - size[0]), max(-drawn.y0, drawn.y1 - size[1])]
    cut = 2 * np.maximum(0.0, beyond)
    for axes in figure.axes:
        place = axes.get_subplotspec()
        if place is not None:
            columns = place.get_gridspec().ncols
            title = axes.title.get_window_extent().width / figure.dpi
            cut[0] = max(cut[0], columns * (title + TITLE_GAP) - size[0] if columns > 1 else 0.0)
    return cut


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
        axes.yaxis.set_major_locator(MaxNLocator(5))
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
    widest = 0.8 + 0.1 * max(map(len, entries), default=0)
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


def draw_seeds(panel: Axes, x: np.ndarray, lines: np.ndarray, color: Any) -> None:
    """
    Draw a thin line for each run.

    :param panel: the panel
    :param x: abscissae (E)
    :param lines: ordinates of the runs (N, E)
    :param color: the colour of the runs' method
    """
    panel.plot(x, lines.T, color=color, label="_seed", **SEED)


def label_ends(panel: Axes, ends: dict[str, tuple[float, Any]]) -> None:
    """
    Write the name of each line beside its right end, names that would overlap a little apart.

    :param panel: the panel, with its final limits
    :param ends: the last ordinate and the colour of each line, by its name
    """
    low, high = panel.get_ylim()
    figure = panel.get_figure(root=True)
    assert figure is not None
    height = panel.get_position().height * figure.get_figheight()
    gap = (high - low) * 1.25 * LOOK["font.size"] / 72 / height
    names = sorted(ends, key=lambda name: ends[name][0])
    places: list[float] = []
    for name in names:
        wanted = min(max(ends[name][0], low), high)
        places.append(max(wanted, places[-1] + gap) if places else wanted)
    excess = max(0.0, places[-1] - high) if places else 0.0
    for number in range(len(places) - 1, -1, -1):
        places[number] -= excess
        if number > 0:
            excess = max(0.0, places[number - 1] + gap - places[number])
    right = panel.get_xlim()[1]
    for name, place in zip(names, places, strict=True):
        # The colours of lines are too light for letters
        color = tuple(0.7 * part for part in to_rgb(ends[name][1]))
        look: dict[str, Any] = dict(textcoords="offset points", va="center", annotation_clip=False, color=color)
        panel.annotate(name, (right, place), (5, 0), **look)


def label_below(panel: Sequence[Axes], text: str) -> None:
    """
    Label the horizontal axis, which is the same in all panels, once, and begin it at 0.

    :param panel: all panels of the figure
    :param text: the label
    """
    right = max(axes.get_xlim()[1] for axes in panel)
    for axes in panel:
        axes.set_xlim(0, right)
    if len(panel) == 1:
        panel[0].set_xlabel(text)
    else:
        figure = panel[0].get_figure(root=True)
        assert figure is not None
        figure.supxlabel(text, fontsize=LOOK["axes.labelsize"])


def count_steps(panel: Sequence[Axes]) -> None:
    """
    Label the horizontal axis with environment steps.

    :param panel: all panels of the figure
    """
    label_below(panel, "environment steps")
    for axes in panel:
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
