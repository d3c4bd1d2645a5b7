"""
Measure how the cost of training grows: with CEM's settings, the networks, the spaces and the number of parallel environments.

``python -m benchmark.scaling`` writes ``scaling.png`` and ``scaling.json``.
"""

import argparse
from collections.abc import Sequence

from benchmark.common.arguments import count
from benchmark.common.measuring import add_environment, measure_and_publish, measuring_parser
from benchmark.speed.scaling_figure import draw
from benchmark.speed.scaling_points import AXES, measure
from sb3_cgp.common.files import write_atomically

RECORDED = ("env", "seed", "rounds", "gradient_steps")


def parse(argv: Sequence[str]) -> argparse.Namespace:
    """
    Read the command line.

    :param argv: the arguments
    :return: the parsed arguments
    """
    parser = measuring_parser(
        "scaling",
        "Measure how the cost of training grows.",
        example="--rounds 2 --axes cem_samples",
        duration="up to a quarter of an hour",
    )
    parser.add_argument("--rounds", type=count, default=10, help="timed runs of each setting (default: %(default)s)")
    # An even number, as TD3 updates its actor in every second one
    parser.add_argument("--gradient-steps", type=count, default=10, help="gradient steps per run (default: %(default)s)")
    add_environment(parser, "environment to run several of in parallel")
    parser.add_argument("--axes", nargs="+", choices=list(AXES), default=list(AXES), help="axes to vary (default: all)")
    return parser.parse_args(argv)


def main(argv: Sequence[str] | None = None) -> None:
    """
    Measure, and draw the figure.

    :param argv: the command line; None for that of the process
    """
    args, record = measure_and_publish("scaling", parse, measure, RECORDED, argv=argv)
    write_atomically(args.folder / "scaling.png", draw(record))
    print(f"{args.folder / 'scaling.png'}\n{args.folder / 'scaling.json'}")


if __name__ == "__main__":
    main()
