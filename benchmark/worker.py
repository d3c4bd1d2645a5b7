"""
Train the runs of a study: the process claims a run, trains it, and claims the next, until all have ended.

``benchmark.sweep`` starts such processes; ``python -m benchmark.worker --help`` tells how to start one by hand.
"""

import argparse
import os
import socket
import sys
from collections.abc import Sequence
from pathlib import Path

import optuna
import torch as th

from benchmark.common.arguments import add_epilog, count, device_name
from benchmark.sweeps.endings import errors_in_words
from benchmark.sweeps.groups import add_population, population_size
from benchmark.sweeps.processes import add_heartbeats, check_grace
from benchmark.sweeps.signals import handle_as_worker
from benchmark.sweeps.storages import open_storage, patiently
from benchmark.sweeps.studies import Ledger
from benchmark.sweeps.worker_loop import execute_runs
from sb3_cgp.common.rules import require


def parse(argv: Sequence[str]) -> argparse.Namespace:
    """
    Read the command line.

    :param argv: the arguments
    :return: the parsed arguments
    """
    parser = argparse.ArgumentParser(prog="python -m benchmark.worker", description="Train the runs of a study.")
    parser.add_argument("--study", required=True, help="the study's name")
    parser.add_argument("--storage", required=True, help="the URL of its storage")
    parser.add_argument("--logs", type=Path, required=True, help="the folder of all sweeps' runs")
    parser.add_argument("--threads", type=count, default=1, help="PyTorch's threads (default: %(default)s)")
    parser.add_argument("--device", type=device_name, default="auto", help="device of the networks (default: %(default)s)")
    add_population(parser)
    add_heartbeats(parser)
    parser.add_argument("--parent", type=int, help="the process whose end is this one's, too")
    add_epilog(
        parser,
        "example, for a study that benchmark.sweep has begun:\n"
        "  python -m benchmark.worker --study e3-Pendulum-v1 --storage sqlite:///logs/sweeps/studies.db --logs logs/sweeps",
        "The process ends when no run is left. Its runs lie in --logs; benchmark.sweep, given again, writes the page on them.",
    )
    return parser.parse_args(argv)


def open_ledger(args: argparse.Namespace) -> Ledger:
    """
    Open the study that the command line names.

    :param args: the command line
    :return: the study
    :raises ValueError: if an option is wrong, the storage holds no such study, or another version of sb3-cgp began it
    """
    check_grace(args.beat, args.grace)
    storage = patiently(open_storage, args.storage, create=False)
    names = optuna.get_all_study_names(storage)
    allowed = f"a study that benchmark.sweep has begun in this storage, which holds {', '.join(names) or 'none'}"
    require(args.study in names, "study", args.study, allowed)
    ledger = Ledger(storage, args.study, args.grace)
    # Refuses the runs of another version before any is claimed
    ledger.recover()
    return ledger


def main(argv: Sequence[str] | None = None) -> None:
    """
    Train the runs of a study.

    :param argv: the command line; None for that of the process
    """
    args = parse(sys.argv[1:] if argv is None else argv)
    handle_as_worker(args.parent)
    th.set_num_threads(args.threads)
    with errors_in_words(ValueError):
        ledger = open_ledger(args)
    size = population_size(args.population, args.device)
    execute_runs(ledger, args.logs, f"{socket.gethostname()}:{os.getpid()}", args.beat, args.parent, args.device, size)


if __name__ == "__main__":
    main()
