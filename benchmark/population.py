"""
Measure the speed of a population by the number of its agents.

``python -m benchmark.population`` writes ``population.json``, ``population.md`` and ``population.png`` after every point. The
same command continues: points that are there are kept.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from typing import Any

import torch as th

from benchmark.common.arguments import count
from benchmark.common.files import read_json, write_json
from benchmark.common.measuring import TIME_OVER, add_environment, measuring_parser
from benchmark.common.provenance import conditions
from benchmark.speed.card_estimates import estimate_all
from benchmark.speed.population_methods import METHODS
from benchmark.speed.population_points import measure_point, measure_product_rate, points_in_order
from sb3_cgp.common.files import write_atomically
from sb3_cgp.population.processes import available_cores

# What is kept of an earlier call
FOUND = ("points", "product_rate", "estimates")
RECORDED = ("env", "seed", "rounds", "steps", "processes")
NUMBERS = [1, 4, 8, 16, 32, 64]


def parse(argv: Sequence[str]) -> argparse.Namespace:
    """
    Read the command line.

    :param argv: the arguments
    :return: the parsed arguments
    """
    parser = measuring_parser(
        "population",
        "Measure the speed of a population by the number of its agents.",
        example="--device cpu --numbers 1 4 --rounds 3 --steps 10",
        duration="some minutes on a GPU; without one, give fewer agents",
    )
    parser.add_argument("--numbers", type=count, nargs="+", default=NUMBERS, help="numbers of agents (default: %(default)s)")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS), help="methods (default: all)")
    add_environment(parser)
    parser.add_argument(
        "--processes",
        type=count,
        default=available_cores(),
        help="processes of environments (default: the cores, %(default)s)",
    )
    parser.add_argument("--rounds", type=count, default=5, help="timed rounds of each point (default: %(default)s)")
    # An even number, as TD3 updates its actors in every second one
    parser.add_argument("--steps", type=count, default=50, help="steps of each agent per round (default: %(default)s)")
    parser.add_argument("--minutes", type=float, help="begin no point after this time (default: no limit)")
    parser.add_argument(
        "--estimate",
        action=argparse.BooleanOptionalAction,
        help="estimate the speeds in HalfCheetah-v5 on a GPU from counts of operators (default: without a GPU)",
    )
    parser.add_argument("--only-estimate", action="store_true", help="estimate, and measure nothing")
    args = parser.parse_args(argv)
    if args.estimate is None:
        args.estimate = args.only_estimate or args.device.type != "cuda"
    return args


def kept(args: argparse.Namespace, given: dict[str, Any]) -> dict[str, Any]:
    """
    Return what an earlier call has found, if it measured in the same way.

    :param args: the command line
    :param given: the conditions of this call
    :return: the points, and, where there are any, the device's rate and the estimates
    """
    path = args.folder / "population.json"
    if not path.exists():
        return {"points": []}
    try:
        record = read_json(path, ("points", "machine", *RECORDED), "Move it away, and give the same command again.")
    except ValueError as error:
        sys.exit(f"Error: {error}")

    def way(record: dict[str, Any]) -> list[Any]:
        hardware = [record["machine"][name] for name in ("cpu", "gpu", "device", "torch_threads")]
        return [*hardware, *(record[name] for name in RECORDED)]

    if not record["points"] or way(record) == way(given):
        return {name: record[name] for name in FOUND if name in record}
    sys.exit(f"Error: {path} was measured in another way, with {way(record)} in place of {way(given)}: give another --folder.")


def publish(args: argparse.Namespace, record: dict[str, Any]) -> None:
    """
    Write the record, its page and its figure; the latter two where the packages are installed that they need.

    :param args: the command line
    :param record: the record
    """
    write_json(args.folder / "population.json", record)
    try:
        # Not at the top: a bare machine may have neither
        from benchmark.speed.population_page import markdown

        write_atomically(args.folder / "population.md", markdown(record).encode())
        from benchmark.speed.population_figure import draw

        write_atomically(args.folder / "population.png", draw(record))
    except ImportError as error:
        print(f"Page or figure not written: {error}. The same command writes them where it is installed.")


def main(argv: Sequence[str] | None = None) -> None:
    """
    Measure, and write the results after every point.

    :param argv: the command line; None for that of the process
    """
    start = time.monotonic()
    argv = sys.argv[1:] if argv is None else argv
    args = parse(argv)
    th.set_num_threads(args.threads)
    record = conditions("benchmark.population", argv, args.device) | {name: getattr(args, name) for name in RECORDED}
    record |= kept(args, record)
    if not args.only_estimate:
        record["product_rate"] = measure_product_rate(args.device)
    if args.estimate:
        record["estimates"] = estimate_all(args.methods, args.numbers)
        publish(args, record)
    done = {(point["method"], point["n_agents"]) for point in record["points"]}
    for method, n_agents in points_in_order(args.methods, args.numbers):
        if (method, n_agents) in done or args.only_estimate:
            continue
        if args.minutes is not None and time.monotonic() - start > 60 * args.minutes:
            print("The time is over. The same command continues.")
            sys.exit(TIME_OVER)
        point = measure_point(method, n_agents, args)
        record["points"].append(point)
        publish(args, record)
        speed = point["agent_steps_per_second"]["median"]
        print(f"{method}, {n_agents or 'alone'}: {speed:,.0f} agent-steps/s", flush=True)
    publish(args, record)
    print(args.folder / "population.md")


if __name__ == "__main__":
    main()
