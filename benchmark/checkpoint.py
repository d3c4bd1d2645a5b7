"""
Measure the time that it takes to save and to load a whole training state, with a full replay buffer.

``python -m benchmark.checkpoint`` writes ``checkpoint.md`` and ``checkpoint.json``.
"""

import argparse
from collections.abc import Sequence

from benchmark.common.arguments import count
from benchmark.common.measuring import add_environment, measure_and_publish, measuring_parser
from benchmark.speed.checkpoints import markdown, measure

RECORDED = ("env", "seed", "transitions", "new", "rounds")


def parse(argv: Sequence[str]) -> argparse.Namespace:
    """
    Read the command line.

    :param argv: the arguments
    :return: the parsed arguments
    """
    parser = measuring_parser(
        "checkpoint",
        "Measure the time that it takes to save and to load a training state.",
        example="--transitions 10000 --rounds 2",
        duration="minutes, and memory and disk for a million transitions",
    )
    add_environment(parser)
    parser.add_argument(
        "--transitions", type=count, default=1_000_000, help="size of the replay buffer (default: %(default)s)"
    )
    parser.add_argument("--new", type=count, default=10_000, help="steps between two states (default: %(default)s)")
    parser.add_argument("--rounds", type=count, default=5, help="timed rounds (default: %(default)s)")
    return parser.parse_args(argv)


def main(argv: Sequence[str] | None = None) -> None:
    """
    Measure, and write the table.

    :param argv: the command line; None for that of the process
    """
    measure_and_publish("checkpoint", parse, measure, RECORDED, markdown, argv)


if __name__ == "__main__":
    main()
