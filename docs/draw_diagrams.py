"""
Draw Mermaid's flowcharts, which Git hosts draw themselves, as SVG for the pages of the site.

It needs neither a browser nor a network nor Mermaid's megabytes of JavaScript. It knows only what the pages use: nodes,
arrows, and dotted arrows with labels that lead back.
"""

import html
import re
import textwrap
from dataclasses import dataclass, field

LETTER, LINE, PADDING = 9.0, 22, 14
# Between boxes of one rank, and between ranks
BESIDE, BETWEEN = 18, 46
WRAP = 22
NODE = r'(\w+)(?:\["([^"]+)"\])?'
# What is not within a label
OUTSIDE = r'(?=(?:[^"]*"[^"]*")*[^"]*$)'
ARROW = re.compile(r'(?:-->|-\.\s*"([^"]+)"\s*\.->)' + OUTSIDE)


@dataclass
class Box:
    """A node: its lines of text, the number of them that are bold, its rank, and its place."""

    lines: list[str]
    bold: int
    rank: int = 0
    x: float = 0.0
    y: float = 0.0

    @property
    def width(self) -> float:
        """The width of the box."""
        return max(len(line) for line in self.lines) * LETTER + 2 * PADDING

    @property
    def height(self) -> float:
        """The height of the box."""
        return len(self.lines) * LINE + 2 * PADDING - 6


@dataclass
class Chart:
    """A flowchart: its direction, its boxes by name, its arrows, and the labelled arrows that lead back."""

    direction: str
    boxes: dict[str, Box] = field(default_factory=dict)
    arrows: list[tuple[str, str]] = field(default_factory=list)
    back: list[tuple[str, str, str]] = field(default_factory=list)


def parse(text: str) -> Chart:
    """
    Read a flowchart.

    :param text: Mermaid's text
    :return: the flowchart
    :raises ValueError: if a line is none of those that the pages use
    """
    first, *lines = [line.strip() for line in text.strip().splitlines() if line.strip()]
    if first not in ("flowchart BT", "flowchart LR"):
        raise ValueError(f"diagram: {first!r} must be 'flowchart BT' or 'flowchart LR'")
    chart = Chart(first.split()[1])
    for line in lines:
        # Groups of nodes, and between them the labels of arrows, None for an arrow without one
        first_group, *rest = ARROW.split(line)
        previous = _group(chart, first_group, line)
        for label, group in zip(rest[::2], rest[1::2], strict=True):
            names = _group(chart, group, line)
            for start in previous:
                chart.arrows += [(start, end) for end in names if label is None]
                chart.back += [(start, end, label) for end in names if label is not None]
            previous = names
    return chart


def _group(chart: Chart, text: str, line: str) -> list[str]:
    """Add the nodes of a group, such as ``a & b``, and return their names."""
    names = []
    for part in re.split("&" + OUTSIDE, text):
        match = re.fullmatch(NODE, part.strip())
        if match is None:
            raise ValueError(f'diagram: {line!r} must be name["label"], a & b --> c, or a -. "label" .-> b')
        name, words = match.groups()
        if words is not None or name not in chart.boxes:
            chart.boxes[name] = _box(words or name)
        names.append(name)
    return names


def _box(words: str) -> Box:
    lines, bold = [], 0
    for part in words.split("<br>"):
        wrapped = textwrap.wrap(re.sub(r"</?b>", "", part), WRAP)
        bold += len(wrapped) * ("<b>" in part)
        lines += wrapped
    return Box(lines, bold)


def place(chart: Chart) -> tuple[float, float]:
    """
    Give each box its place: a rank after those that lead to it, and beside them the middle of those.

    :param chart: the flowchart, of which the places are set
    :return: the width and the height of the picture, without the arrows that lead back
    """
    boxes = chart.boxes
    for _ in boxes:
        for start, end in chart.arrows:
            boxes[end].rank = max(boxes[end].rank, boxes[start].rank + 1)
            if boxes[end].rank >= len(boxes):
                raise ValueError(f"diagram: the arrows to {end} are a circle; dotted arrows with a label may lead back")
    ranks = [
        [box for box in boxes.values() if box.rank == rank] for rank in range(1 + max(box.rank for box in boxes.values()))
    ]
    if chart.direction == "LR":
        x, middle = 0.0, max(box.height for box in boxes.values()) / 2
        for (box,) in (rank for rank in ranks):
            box.x, box.y, x = x + box.width / 2, middle, x + box.width + BETWEEN
        return x - BETWEEN, 2 * middle
    width = max(sum(box.width + BESIDE for box in rank) - BESIDE for rank in ranks)
    y = 0.0
    # The first rank is at the bottom
    for rank in reversed(ranks):
        height = max(box.height for box in rank)
        x = (width - (sum(box.width + BESIDE for box in rank) - BESIDE)) / 2
        for box in rank:
            box.x, box.y, x = x + box.width / 2, y + height / 2, x + box.width + BESIDE
        y += height + BETWEEN
    for rank in ranks:
        if len(rank) == 1:
            leading = [boxes[start].x for start, end in chart.arrows if boxes[end] is rank[0]]
            if leading:
                rank[0].x = min(max(sum(leading) / len(leading), rank[0].width / 2), width - rank[0].width / 2)
    return width, y - BETWEEN


def svg(text: str) -> str:
    """
    Draw a flowchart.

    :param text: Mermaid's text
    :return: an SVG element, whose colours are those of the page
    """
    chart = parse(text)
    width, height = place(chart)
    shapes, arrows, labels = [], [], []
    for box in chart.boxes.values():
        left, top = box.x - box.width / 2, box.y - box.height / 2
        shapes.append(f'<rect x="{left:.0f}" y="{top:.0f}" width="{box.width:.0f}" height="{box.height:.0f}" rx="8"/>')
        for number, line in enumerate(box.lines):
            style = ' font-weight="bold"' if number < box.bold else ""
            baseline = top + PADDING + 11 + LINE * number
            shapes.append(f'<text x="{box.x:.0f}" y="{baseline:.0f}"{style}>{html.escape(line)}</text>')
    for start, end in chart.arrows:
        one, other = chart.boxes[start], chart.boxes[end]
        if chart.direction == "LR":
            arrows.append(f'<path d="M{one.x + one.width / 2:.0f},{one.y:.0f} H{other.x - other.width / 2 - 2:.0f}"/>')
        else:
            bottom = other.y + other.height / 2 + 2
            arrows.append(f'<path d="M{one.x:.0f},{one.y - one.height / 2:.0f} L{other.x:.0f},{bottom:.0f}"/>')
    for number, (start, end, label) in enumerate(chart.back, start=1):
        one, other = chart.boxes[start], chart.boxes[end]
        depth, shift = height + 44.0 * number, 10.0 * number
        path = f"M{one.x - shift:.0f},{one.y + one.height / 2:.0f} V{depth:.0f} H{other.x + shift:.0f}"
        arrows.append(f'<path class="dashed" d="{path} V{other.y + other.height / 2 + 2:.0f}"/>')
        labels.append(f'<text x="{(one.x + other.x) / 2:.0f}" y="{depth - 8:.0f}">{html.escape(label)}</text>')
    height += 44 * len(chart.back)
    arrowhead = (
        '<marker id="head" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="7" markerHeight="7" orient="auto-start-reverse">'
        '<path d="M0,0 L10,5 L0,10 z" class="head"/></marker>'
    )
    # Small drawings keep their size, wide ones scroll on a phone
    size = f'style="max-width: min({width:.0f}px, 46rem); min-width: min({width:.0f}px, 34rem)"'
    words = "; ".join(f"{' '.join(chart.boxes[a].lines)} to {' '.join(chart.boxes[b].lines)}" for a, b in chart.arrows)
    return (
        f'<div class="wide"><svg class="diagram drawn" viewBox="-4 -4 {width + 8:.0f} {height + 12:.0f}" role="img" {size} '
        f'aria-label="{html.escape(words)}"><defs>{arrowhead}</defs><g class="arrow">{"".join(arrows)}</g>'
        f'<g class="box">{"".join(shapes)}</g><g class="label">{"".join(labels)}</g></svg></div>'
    )
