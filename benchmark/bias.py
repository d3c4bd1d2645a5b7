"""
Measure how far the critic's values lie above the returns that follow, along the training, for CGP and TD3.

``python -m benchmark.bias`` trains each method and writes a record per run, then ``bias.md`` and ``bias.png``. Runs that have
their record are not repeated, so that it can be interrupted, and run in several processes with different seeds or methods.
"""

import argparse
import sys
from collections.abc import Sequence

import gymnasium as gym
import torch as th
from gymnasium import spaces

from benchmark.common.arguments import continuous_environment, count, seed
from benchmark.common.measuring import measuring_parser
from benchmark.values.bias_page import draw, markdown
from benchmark.values.bias_runs import check_folder, read_records, train_missing
from benchmark.values.episodes import horizon
from benchmark.values.methods import METHODS
from sb3_cgp.common.files import write_atomically


def fraction(text: str) -> float:
    """
    Read a number between 0 and 1.

    :param text: the argument
    :return: the number
    :raises argparse.ArgumentTypeError: if it is not above 0 and below 1
    """
    try:
        number = float(text)
    except ValueError:
        number = 0.0
    if not 0.0 < number < 1.0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number above 0 and below 1")
    return number


def parse(argv: Sequence[str]) -> argparse.Namespace:
    """
    Read the command line.

    :param argv: the arguments
    :return: the parsed arguments
    """
    parser = measuring_parser(
        "bias",
        "Measure how far the critic's values lie above the returns.",
        with_seed=False,
        example="--methods CGP-2 TD3 --seeds 0",
        duration="about 40 minutes",
    )

    def add(option: str, default: int, text: str) -> None:
        parser.add_argument(option, type=count, default=default, help=f"{text} (default: %(default)s)")

    parser.add_argument("--env", type=continuous_environment, default="Hopper-v5", help="environment (default: %(default)s)")
    parser.add_argument("--methods", nargs="+", choices=list(METHODS), default=list(METHODS), help="methods (default: all)")
    parser.add_argument("--seeds", nargs="+", type=seed, default=[0, 1], help="seeds of the training (default: 0 and 1)")
    # From zero, values grow by bootstrapping within some 2 / (τ (1 - γ)) gradient steps: 2,000 by these defaults, 40,000 by
    # the algorithms' own, 0.99 and 0.005
    parser.add_argument("--gamma", type=fraction, default=0.95, help="discount factor (default: %(default)s)")
    parser.add_argument("--tau", type=fraction, default=0.02, help="coefficient of the averages (default: %(default)s)")
    add("--steps", 8_000, "environment steps of each training")
    add("--learning-starts", 1_000, "random steps at the start")
    add("--units", 64, "units per hidden layer of all networks")
    add("--batch-size", 64, "transitions of a minibatch")
    add("--interval", 1_000, "environment steps between two measurements")
    add("--episodes", 3, "episodes of each policy per measurement")
    add("--episode-steps", 1_000, "time limit of these episodes")
    args = parser.parse_args(argv)
    if not isinstance(gym.make(args.env).observation_space, spaces.Box):
        parser.error(f"argument --env: {args.env} must have vectors as observations")
    if args.episode_steps < horizon(args.gamma):
        parser.error(
            f"argument --episode-steps: {args.episode_steps} must be at least {horizon(args.gamma)}, so that a return is known"
        )
    last = args.steps // args.interval * args.interval
    if last <= args.learning_starts:
        parser.error(
            f"argument --interval: {args.interval} must have a multiple above --learning-starts, {args.learning_starts}, and "
            f"not above --steps, {args.steps}, so that something is measured"
        )
    try:
        check_folder(args)
    except ValueError as error:
        parser.error(f"argument --folder: {error}")
    return args


def main(argv: Sequence[str] | None = None) -> None:
    """
    Train the runs that have no record yet, and write the table and the figure of all records.

    :param argv: the command line; None for that of the process
    """
    argv = sys.argv[1:] if argv is None else argv
    args = parse(argv)
    th.set_num_threads(args.threads)
    train_missing(args, argv)
    records = read_records(args.folder)
    text = markdown(records)
    write_atomically(args.folder / "bias.md", text.encode())
    write_atomically(args.folder / "bias.png", draw(records))
    print(text)


if __name__ == "__main__":
    main()
