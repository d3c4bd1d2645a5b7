"""One style per method in all figures: colours of Okabe and Ito's palette, with different lines and markers."""

import zlib
from collections.abc import Iterable
from itertools import product
from typing import Any

METHODS: dict[str, dict[str, Any]] = {
    "CGP-Online": dict(color="#0072B2", linestyle="-", marker="o"),
    "CGP-Offline": dict(color="#56B4E9", linestyle="--", marker="o"),
    "CGP-Light": dict(color="#661100", linestyle="-", marker="P"),
    "QGP-Online": dict(color="#009E73", linestyle="-", marker="^"),
    "QGP-Offline": dict(color="#7A7A00", linestyle="--", marker="^"),
    "CEM": dict(color="#000000", linestyle=":", marker="X"),
    "TD3": dict(color="#D55E00", linestyle="--", marker="s"),
    "SAC": dict(color="#CC79A7", linestyle="-.", marker="D"),
    "DDPG": dict(color="#E69F00", linestyle=(0, (4, 1, 1, 1, 1, 1)), marker="v"),
    "Random": dict(color="#7F7F7F", linestyle=(0, (1, 3)), marker="x"),
}
# For all other methods
FURTHER: list[dict[str, Any]] = [
    dict(color=color, linestyle=linestyle, marker=marker)
    for linestyle, marker, color in product(
        [(0, (6, 2)), (0, (2, 1)), (0, (8, 2, 2, 2))],
        ["p", "*", "<", ">", "h"],
        ["#882255", "#332288", "#117733", "#999933", "#44AA99"],
    )
]


def styles(methods: Iterable[str]) -> dict[str, dict[str, Any]]:
    """
    Return the style of each method.

    :param methods: the methods; the style of one that has none of its own depends on its name alone, unless two would look
        the same
    :return: Matplotlib's colour, line style and marker, by method
    """
    methods = list(methods)
    chosen = {method: METHODS[method] for method in methods if method in METHODS}
    free = list(FURTHER)
    for method in sorted(set(methods) - set(METHODS)):
        start = zlib.crc32(method.encode()) % len(FURTHER)
        look = next((look for look in FURTHER[start:] + FURTHER[:start] if look in free), FURTHER[start])
        chosen[method] = look
        free = [other for other in free if other != look]
    return {method: chosen[method] for method in methods}
