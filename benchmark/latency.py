"""
Measure the time from an observation to an action: by ``predict``, the exported ONNX, and the policy loaded without pickle.

``python -m benchmark.latency`` writes ``latency.md`` and ``latency.json``.
"""

import argparse
from collections.abc import Sequence

from benchmark.common.arguments import count
from benchmark.common.measuring import add_environment, measure_and_publish, measuring_parser
from benchmark.speed.latencies import markdown, measure

RECORDED = ("env", "seed", "rounds", "actions")


def parse(argv: Sequence[str]) -> argparse.Namespace:
    """
    Read the command line.

    :param argv: the arguments
    :return: the parsed arguments
    """
    parser = measuring_parser(
        "latency",
        "Measure the time per action of a policy and of its exports.",
        example="--rounds 10",
        duration="about a minute",
    )
    add_environment(parser)
    parser.add_argument("--rounds", type=count, default=50, help="timed rounds (default: %(default)s)")
    parser.add_argument("--actions", type=count, default=200, help="actions per round (default: %(default)s)")
    return parser.parse_args(argv)


def main(argv: Sequence[str] | None = None) -> None:
    """
    Measure, and write the table.

    :param argv: the command line; None for that of the process
    """
    measure_and_publish("latency", parse, measure, RECORDED, markdown, argv)


if __name__ == "__main__":
    main()
