"""The execution of a sweep: its study is opened, processes of this machine train its runs, and the results are exported."""

import argparse
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from optuna.storages import BaseStorage
from stable_baselines3.common.utils import get_device

from benchmark.common.provenance import conditions
from benchmark.sweeps.experiments import Sweep
from benchmark.sweeps.exports import check_no_run_is_lost, ended_runs, export_study, without_places
from benchmark.sweeps.processes import INTERVAL, start_workers, stopping
from benchmark.sweeps.progress import ProgressTracker, display
from benchmark.sweeps.runs import overview
from benchmark.sweeps.signals import end_if_asked
from benchmark.sweeps.studies import Ledger
from benchmark.sweeps.study_trials import SHARED
from benchmark.sweeps.worker_loop import forget_ended


def describe(sweep: Sweep, argv: Sequence[str], device: str, threads: int = 1) -> dict[str, Any]:
    """
    Describe a sweep, for its study and for the page on its results.

    :param sweep: the sweep
    :param argv: the command line
    :param device: device of the networks
    :param threads: PyTorch's threads in each process
    :return: plain data
    """
    file = sweep.file
    command = conditions("benchmark.sweep", without_places(argv), get_device(device))
    # Not those of this process, which trains nothing
    command["machine"]["torch_threads"] = threads
    return {
        "title": file.title,
        "experiment": sweep.name,
        "axes": {name: list(axis.values) for name, axis in file.axes.items()},
        "steps": file.steps,
        "evaluation_interval": file.evaluation_interval,
        "evaluation_episodes": file.evaluation_episodes,
        "settings_in_words": "; ".join(sweep.changes),
        SHARED: sweep.shared,
        **overview(sweep.runs(), sweep.methods, file.tasks),
        "commands": [command],
    }


def worker_command(args: argparse.Namespace, study: str) -> list[str]:
    """
    Return the command line of a process that trains runs.

    :param args: the command line
    :param study: the study's name
    :return: the command line
    """
    command = [sys.executable, "-m", "benchmark.worker", "--study", study, "--storage", args.storage]
    command += ["--logs", str(args.logs), "--threads", str(args.threads), "--device", args.device]
    command += ["--population", str(args.population)]
    return [*command, "--parent", str(os.getpid()), "--beat", str(args.beat), "--grace", str(args.grace)]


def execute(sweep: Sweep, storage: BaseStorage, study: str, args: argparse.Namespace, argv: Sequence[str]) -> Path:
    """
    Execute the runs of a sweep, by processes of this machine and of all others that share the storage.

    :param sweep: the sweep
    :param storage: the storage of the study
    :param study: the study's name
    :param args: the command line
    :param argv: its arguments
    :return: the folder of the results
    :raises SystemExit: if all processes of this machine have ended, and runs are left
    """
    ledger = Ledger(storage, study, args.grace)
    description = describe(sweep, argv, args.device, args.threads)
    ended, earlier = ended_runs(args.results / study, description) if args.adopt else ([], [])
    description["commands"] = [*earlier, *description["commands"]]
    ledger.open(sweep, description, ended)
    check_no_run_is_lost(args.results / study, ledger)
    others = set(ledger.left()) - {run.key for run in sweep.runs()}
    if others:
        print(
            f"{study} also has {len(others)} runs of earlier commands to train, such as {min(others)}; another --study leaves "
            "them out",
            file=sys.stderr,
        )
    tracker = ProgressTracker(sweep.file.steps)
    # A finished study needs no process that finds nothing to train
    n_workers = args.workers if ledger.left() else 0
    workers = start_workers(worker_command(args, study), n_workers, args.threads, args.logs / study)
    try:
        with stopping(workers), display(study) as show:
            while True:
                # Workers search for lost processes between their runs only
                ledger.recover()
                show(tracker.add(ledger.trials()))
                n_working = sum(worker.poll() is None for worker in workers)
                if n_working == 0:
                    break
                time.sleep(INTERVAL)
                end_if_asked()
    finally:
        folder = export_study(study, args.storage, args.results)
    left = ledger.left()
    if not left:
        forget_ended(ledger, args.logs)
    else:
        codes = ", ".join(str(worker.returncode) for worker in workers)
        sys.exit(
            f"{len(left)} runs of {study} are left, but all workers have ended (exit codes {codes}): "
            f"{args.logs / study}/worker-*.log say why. The same command continues."
        )
    return folder
