"""
Runs a sweep, or goes on with it: ``python -m benchmark.sweep e3 --task Pendulum-v1 --steps 3000 --seeds 2 --workers 2``.

The runs are trials of an Optuna study. The same command, given again after whatever interruption, or on other machines with
the same ``--storage``, takes up what is not finished. At the end it exports the runs and draws the figures.
"""

import argparse
import os
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from stable_baselines3.common.utils import get_device

from benchmark.common.arguments import count, hyperparameter, output_folder
from benchmark.common.provenance import conditions
from benchmark.figures import figures, study_folders
from benchmark.sweeps.experiments import Sweep, included_sweeps, load_sweep, overview
from benchmark.sweeps.exports import ended_runs, export_study, see_that_none_is_lost, without_places
from benchmark.sweeps.processes import (
    add_workers,
    see_that_grace_is_longer,
    share_of_cores,
    start_workers,
    stop,
    terminate,
)
from benchmark.sweeps.progress import Tally, display
from benchmark.sweeps.storages import STORAGE_ERRORS, open_storage, reason_of
from benchmark.sweeps.studies import Ledger
from benchmark.sweeps.sweep_files import SweepError

# Seconds between two looks at the study
LOOK = 2.0


def describe(sweep: Sweep, argv: Sequence[str], device: str, threads: int = 1) -> dict[str, Any]:
    """
    Say what a sweep is, for the study and for the page on it.

    :param sweep: the sweep
    :param argv: the command line
    :param device: where the networks compute
    :param threads: PyTorch's threads in each process
    :return: plain data
    """
    file = sweep.file
    command = conditions("benchmark.sweep", without_places(argv), get_device(device))
    # Not this process's, which trains nothing
    command["machine"]["torch_threads"] = threads
    return {
        "title": file.title,
        "experiment": sweep.name,
        "axes": {name: list(axis.values) for name, axis in file.axes.items()},
        "steps": file.steps,
        "evaluation_interval": file.evaluation_interval,
        "evaluation_episodes": file.evaluation_episodes,
        "settings_in_words": "; ".join(sweep.changes),
        **overview(sweep.runs(), sweep.methods, file.tasks),
        "commands": [command],
    }


def worker_command(args: argparse.Namespace, study: str) -> list[str]:
    """
    Say how to start one of the processes that train.

    :param args: the command line
    :param study: the study's name
    :return: its command line
    """
    command = [sys.executable, "-m", "benchmark.worker", "--study", study, "--storage", args.storage]
    command += ["--logs", str(args.logs), "--threads", str(args.threads), "--device", args.device]
    return [*command, "--parent", str(os.getpid()), "--beat", str(args.beat), "--grace", str(args.grace)]


def run(sweep: Sweep, study: str, args: argparse.Namespace, argv: Sequence[str]) -> Path:
    """
    Work a sweep off, by processes of this machine and whoever else shares the storage.

    :param sweep: the sweep
    :param study: the study's name
    :param args: the command line
    :param argv: its arguments
    :return: the folder of the results
    :raises SystemExit: if runs are left over that no process works on any more
    """
    ledger = Ledger(open_storage(args.storage), study, args.grace)
    description = describe(sweep, argv, args.device, args.threads)
    ended, earlier = ended_runs(args.results / study, description) if args.adopt else ([], [])
    description["commands"] = [*earlier, *description["commands"]]
    ledger.open(sweep, description, ended)
    see_that_none_is_lost(args.results / study, ledger)
    tally = Tally(sweep.file.steps)
    workers = start_workers(worker_command(args, study), args.workers, args.threads, args.logs / study)
    try:
        with display(study) as show:
            while True:
                # Workers look for lost processes between their runs only
                ledger.recover()
                show(tally.look(ledger.trials()))
                n_working = sum(worker.poll() is None for worker in workers)
                if n_working == 0:
                    break
                time.sleep(LOOK)
    except BaseException:
        stop(workers)
        print("Stopped. The same command goes on.", file=sys.stderr)
        raise
    finally:
        folder = export_study(study, args.storage, args.results)
    left = ledger.left()
    if left:
        codes = ", ".join(str(worker.returncode) for worker in workers)
        sys.exit(
            f"{len(left)} runs of {study} are left over, but all workers have ended (exit codes {codes}): "
            f"{args.logs / study}/worker-*.log say why. The same command goes on."
        )
    return folder


def parse(argv: Sequence[str]) -> argparse.Namespace:
    """
    Read the command line.

    :param argv: the arguments
    :return: what they say
    """
    # No abbreviations: what is not to be recorded is known by its name
    parser = argparse.ArgumentParser(
        prog="python -m benchmark.sweep", description="Run a sweep, or go on with it.", allow_abbrev=False
    )
    parser.add_argument("name", help="e1 to e8, the paper's, or the path of a sweep's file")
    parser.add_argument("--task", nargs="+", help="environments, in place of the file's")
    parser.add_argument("--steps", type=count, help="environment steps of each run, in place of the file's")
    parser.add_argument("--seeds", type=count, help="how many seeds, from 0, in place of the file's")
    parser.add_argument("--methods", nargs="+", help="those of the file's methods to take (default: all)")
    parser.add_argument(
        "--set", nargs="+", type=hyperparameter, default=[], metavar="NAME=VALUE", help="hyperparameters of all"
    )
    parser.add_argument(
        "--eval-interval",
        type=count,
        help="environment steps between two evaluations (default: the file's, or a twentieth of --steps)",
    )
    parser.add_argument("--eval-episodes", type=count, help="episodes of each evaluation, in place of the file's")
    parser.add_argument("--study", help="the study's name (default: the sweep's, with the tasks if they were replaced)")
    add_workers(parser, "logs/sweeps")
    parser.add_argument("--results", type=output_folder, default="benchmark/results/sweeps", help="where the results go")
    parser.add_argument(
        "--adopt", action="store_true", help="take the ended runs that the folder of results has, trained elsewhere"
    )
    args = parser.parse_args(argv)
    args.threads = args.threads or share_of_cores(args.workers)
    return args


def load(name: str, args: argparse.Namespace) -> Sweep:
    """
    Read a sweep with what the command line changes.

    :param name: the sweep
    :param args: the command line
    :return: the sweep
    """
    overrides = dict(
        tasks=args.task,
        steps=args.steps,
        seeds=args.seeds,
        evaluation_interval=args.eval_interval,
        evaluation_episodes=args.eval_episodes,
        hyperparams=dict(args.set) or None,
    )
    return load_sweep(name, overrides, args.methods)


def study_name(sweep: Sweep, args: argparse.Namespace) -> str:
    """
    Name a sweep's study.

    :param sweep: the sweep
    :param args: the command line
    :return: the name
    """
    if args.study is not None:
        return args.study
    return "-".join([sweep.name, *(args.task or [])])


def main(argv: Sequence[str] | None = None) -> None:
    """
    Run a sweep.

    :param argv: the command line; None for the process's own
    """
    argv = sys.argv[1:] if argv is None else argv
    args = parse(argv)
    signal.signal(signal.SIGTERM, terminate)
    try:
        see_that_grace_is_longer(args.beat, args.grace)
        names = included_sweeps(args.name)
        sweeps = [load(name, args) for name in names]
        if args.study is not None and len(sweeps) > 1:
            raise SweepError("the command line", "--study", f"names one study, but {args.name} is {len(sweeps)} sweeps")
        folders = [run(sweep, study_name(sweep, args), args, argv) for sweep in sweeps]
    except (SweepError, ValueError) as error:
        sys.exit(f"Error: {error}")
    except STORAGE_ERRORS as error:
        sys.exit(f"Error: the storage does not answer: {reason_of(error)}. When it does, the same command goes on.")
    except KeyboardInterrupt:
        sys.exit(128 + signal.SIGINT)
    print(f"The page is {figures(sorted({*folders, *study_folders(args.results)}), args.results)}")


if __name__ == "__main__":
    main()
