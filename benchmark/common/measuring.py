"""The frame of the commands that measure: their common arguments, and the record of how they measured."""

import argparse
import sys
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch as th

from benchmark.common.arguments import add_epilog, continuous_environment, count, device, output_folder, seed
from benchmark.common.files import publish
from benchmark.common.provenance import conditions

# The exit code of a command that has reached its time limit, as that of coreutils' `timeout`; pytest's own are 0 to 5
TIME_OVER = 124


def measuring_parser(
    name: str, description: str, example: str, duration: str, with_seed: bool = True
) -> argparse.ArgumentParser:
    """
    Return the parser of a command that measures.

    :param name: the command's module within ``benchmark``
    :param description: the command's description
    :param example: options of an example, a shorter measurement
    :param duration: the time that the command takes without options, as text
    :param with_seed: whether the command takes one seed; False for a command that takes several
    :return: the parser, with the arguments of all such commands
    """
    parser = argparse.ArgumentParser(prog=f"python -m benchmark.{name}", description=description)

    def add(option: str, kind: Callable[[str], object], default: object, text: str) -> None:
        parser.add_argument(option, type=kind, default=default, help=f"{text} (default: %(default)s)")

    add("--threads", count, 1, "PyTorch's threads")
    add("--device", device, "auto", "device of the networks")
    if with_seed:
        add("--seed", seed, 0, "seed of the random numbers")
    add("--folder", output_folder, f"results/{name}", "folder of the results")
    add_epilog(
        parser,
        f"examples:\n  python -m benchmark.{name}\n  python -m benchmark.{name} {example}",
        f"It takes {duration}.",
        f"The table or picture and its data are written to --folder. This repository's own are in benchmark/results/{name}.",
    )
    return parser


def add_environment(parser: argparse.ArgumentParser, text: str = "the environment") -> None:
    """
    Add the argument on the environment.

    :param parser: the command's parser
    :param text: what the environment is for
    """
    text = f"{text} (default: %(default)s)"
    parser.add_argument("--env", type=continuous_environment, default="HalfCheetah-v5", help=text)


def measure_and_publish(
    name: str,
    parse: Callable[[Sequence[str]], argparse.Namespace],
    measure: Callable[[argparse.Namespace], dict[str, Any]],
    recorded: Iterable[str],
    markdown: Callable[[dict[str, Any]], str] | None = None,
    argv: Sequence[str] | None = None,
) -> tuple[argparse.Namespace, dict[str, Any]]:
    """
    Execute a command that measures: read its arguments, measure, and write ``name.json`` and ``name.md``.

    :param name: the command's module within ``benchmark``
    :param parse: reads the command line
    :param measure: measures, and returns fields of the record
    :param recorded: the arguments that the record repeats
    :param markdown: writes the page of a record; None for no page
    :param argv: the command line; None for that of the process
    :return: the arguments, and the record
    """
    argv = sys.argv[1:] if argv is None else argv
    args = parse(argv)
    th.set_num_threads(args.threads)
    record = {
        **conditions(f"benchmark.{name}", argv, args.device),
        **{argument: getattr(args, argument) for argument in recorded},
        **measure(args),
    }
    publish(args.folder, name, record, None if markdown is None else markdown(record))
    return args, record
