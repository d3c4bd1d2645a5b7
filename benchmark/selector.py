"""
Measure the time of one CEM call by its sizes and data types, beside a straightforward implementation and its matrix
products alone.

``python -m benchmark.selector`` writes ``selector.md`` and ``selector.json``.
"""

import argparse
from collections.abc import Sequence

from benchmark.common.arguments import count
from benchmark.common.measuring import measure_and_publish, measuring_parser
from benchmark.speed.cem_call_table import markdown
from benchmark.speed.cem_calls import DTYPES, VARIATIONS, measure

RECORDED = ("seed", "rounds")


def parse(argv: Sequence[str]) -> argparse.Namespace:
    """
    Read the command line.

    :param argv: the arguments
    :return: the parsed arguments
    """
    parser = measuring_parser(
        "selector",
        "Measure one CEM call across its sizes and data types.",
        example="--rounds 5 --vary",
        duration="up to a quarter of an hour",
    )
    parser.add_argument("--rounds", type=count, default=20, help="timed calls of each kind (default: %(default)s)")
    parser.add_argument(
        "--dtypes", nargs="+", choices=list(DTYPES), default=list(DTYPES), help="hidden layers' data types (default: both)"
    )
    parser.add_argument(
        "--vary", nargs="*", choices=list(VARIATIONS), default=list(VARIATIONS), help="sizes to vary (default: all)"
    )
    return parser.parse_args(argv)


def main(argv: Sequence[str] | None = None) -> None:
    """
    Measure, and write the table.

    :param argv: the command line; None for that of the process
    """
    measure_and_publish("selector", parse, measure, RECORDED, markdown, argv)


if __name__ == "__main__":
    main()
