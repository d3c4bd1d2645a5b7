"""
Measure ways of stepping the environments of a population.

``python -m benchmark.environments_in_step`` writes ``environments_in_step.md`` and ``environments_in_step.json``.
"""

import argparse
import sys
from collections.abc import Sequence
from typing import Any

import torch as th

from benchmark.common.arguments import count
from benchmark.common.files import publish
from benchmark.common.measuring import add_environment, measuring_parser
from benchmark.common.provenance import conditions
from benchmark.speed.environment_page import markdown
from benchmark.speed.environment_steps import measure
from benchmark.speed.environment_ways import WAYS
from sb3_cgp.population.processes import available_cores

RECORDED = ("env", "seed", "rounds", "steps", "processes")


def parse(argv: Sequence[str]) -> argparse.Namespace:
    """
    Read the command line.

    :param argv: the arguments
    :return: the parsed arguments
    """
    parser = measuring_parser(
        "environments_in_step",
        "Measure ways of stepping the environments of a population.",
        example="--numbers 4 --rounds 2 --env Pendulum-v1",
        duration="some minutes",
    )
    add_environment(parser)
    parser.add_argument(
        "--numbers", type=count, nargs="+", default=[8, 32, 128], help="numbers of environments (default: %(default)s)"
    )
    parser.add_argument("--ways", nargs="+", choices=list(WAYS), default=list(WAYS), help="ways to measure (default: all)")
    parser.add_argument(
        "--processes",
        type=count,
        default=available_cores(),
        help="processes or threads, where a way has a number of them (default: the available cores, %(default)s)",
    )
    parser.add_argument("--rounds", type=count, default=10, help="timed rounds (default: %(default)s)")
    parser.add_argument("--steps", type=count, default=20, help="steps of each environment per round (default: %(default)s)")
    return parser.parse_args(argv)


def main(argv: Sequence[str] | None = None) -> None:
    """
    Measure, and write the page after each number of environments.

    :param argv: the command line; None for that of the process
    """
    argv = sys.argv[1:] if argv is None else argv
    args = parse(argv)
    th.set_num_threads(args.threads)
    given = conditions("benchmark.environments_in_step", argv, args.device) | {name: getattr(args, name) for name in RECORDED}

    def write(fields: dict[str, Any]) -> None:
        publish(args.folder, "environments_in_step", given | fields, markdown(given | fields))

    measure(args, write)


if __name__ == "__main__":
    main()
