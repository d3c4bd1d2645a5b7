"""
Measure the paper's run-time table on this machine: seconds per episode of training and of inference, and ratios to TD3.

``python -m benchmark.runtime`` writes ``runtime.md`` and ``runtime.json``.
"""

import argparse
from collections.abc import Sequence

from benchmark.common.arguments import count
from benchmark.common.measuring import add_environment, measure_and_publish, measuring_parser
from benchmark.speed.contenders import CONTENDERS
from benchmark.speed.run_times import measure
from benchmark.speed.runtime_table import markdown

RECORDED = ("env", "seed", "episode_steps", "episodes", "inference_episodes", "cem_dtype")


def parse(argv: Sequence[str]) -> argparse.Namespace:
    """
    Read the command line.

    :param argv: the arguments
    :return: the parsed arguments
    """
    parser = measuring_parser(
        "runtime",
        "Measure the paper's run-time table.",
        example="--methods TD3 CGP-2 --episodes 2 --inference-episodes 2",
        duration="about 40 minutes on a core of an AMD EPYC",
    )
    parser.add_argument("--episodes", type=count, default=10, help="training episodes per method (default: %(default)s)")
    parser.add_argument(
        "--inference-episodes", type=count, default=30, help="inference episodes per method (default: %(default)s)"
    )
    parser.add_argument("--episode-steps", type=count, default=1000, help="steps per episode (default: %(default)s)")
    add_environment(parser, "environment")
    parser.add_argument(
        "--methods", nargs="+", choices=list(CONTENDERS), default=list(CONTENDERS), help="methods to measure (default: all)"
    )
    parser.add_argument(
        "--cem-dtype",
        choices=["auto", "float32", "bfloat16"],
        help="data type of CEM's hidden layers in CEM-2, CEM-4, CGP-2, CGP-4 and both CGP-Light (default: CGP's own)",
    )
    return parser.parse_args(argv)


def main(argv: Sequence[str] | None = None) -> None:
    """
    Measure, and write the table.

    :param argv: the command line; None for that of the process
    """
    measure_and_publish("runtime", parse, measure, RECORDED, markdown, argv)


if __name__ == "__main__":
    main()
