"""
Measure the effect of bfloat16: the share of CEM's elites that differ from float32's on a trained critic, and final returns.

``python -m benchmark.precision`` trains with both data types and writes a record per run, then ``precision.md``. Runs that
have their record are not repeated, so that it can be interrupted, and run in several processes with different seeds.
"""

import argparse
import sys
from collections.abc import Sequence

import torch as th

from benchmark.common.arguments import continuous_environment, count, seed
from benchmark.common.measuring import measuring_parser
from benchmark.speed.precision_runs import check_folder, read_records, train_missing
from benchmark.speed.precision_tables import markdown
from sb3_cgp.common.files import write_atomically


def parse(argv: Sequence[str]) -> argparse.Namespace:
    """
    Read the command line.

    :param argv: the arguments
    :return: the parsed arguments
    """
    parser = measuring_parser(
        "precision",
        "Compare training with CEM in bfloat16 and in float32.",
        with_seed=False,
        example="--envs Pendulum-v1 --steps 3000 --seeds 0",
        duration="up to a quarter of an hour on Pendulum-v1, and hours on the paper's tasks",
    )
    parser.add_argument(
        "--envs", nargs="*", type=continuous_environment, default=["Pendulum-v1"], help="environments (default: Pendulum-v1)"
    )
    parser.add_argument(
        "--steps", type=count, help="environment steps (default: those of the YAML file, 1e6 for the paper's tasks)"
    )
    parser.add_argument(
        "--seeds", nargs="+", type=seed, default=[0, 1, 2, 3, 4], help="seeds of the training (default: 0 to 4)"
    )
    args = parser.parse_args(argv)
    try:
        check_folder(args)
    except ValueError as error:
        parser.error(f"argument --folder: {error}")
    return args


def main(argv: Sequence[str] | None = None) -> None:
    """
    Train the runs that have no record yet, and write the tables of all records.

    :param argv: the command line; None for that of the process
    """
    argv = sys.argv[1:] if argv is None else argv
    args = parse(argv)
    th.set_num_threads(args.threads)
    train_missing(args, argv)
    text = markdown(read_records(args.folder))
    write_atomically(args.folder / "precision.md", text.encode())
    print(text)


if __name__ == "__main__":
    main()
