"""The execution of a tuning by processes of this machine, until enough configurations have ended."""

import argparse
import os
import sys
import time
from collections.abc import Sequence

from optuna.trial import FrozenTrial, TrialState

from benchmark.sweeps.processes import INTERVAL, PAUSE, start_workers, stopping
from benchmark.sweeps.signals import TERMINATED, end_if_asked
from benchmark.sweeps.study_trials import ERROR
from benchmark.sweeps.tuner import Tuner, best_of, has_ended


def execute_trials(tuner: Tuner, args: argparse.Namespace) -> None:
    """
    Train configurations until enough have ended.

    :param tuner: the study
    :param args: the command line
    :raises SystemExit: if the process has to end; its trial is given back
    """
    while True:
        end_if_asked()
        tuner.recover()
        trials = tuner.trials()
        n_ended = sum(map(has_ended, trials))
        n_running = sum(trial.state is TrialState.RUNNING for trial in trials)
        if n_ended >= args.trials:
            return
        if n_ended + n_running < args.trials or any(trial.state is TrialState.WAITING for trial in trials):
            tuner.attempt(args.logs, args.beat, args.parent, args.device)
        else:
            # Trials of other processes, or of lost ones whose grace period has not passed
            time.sleep(PAUSE)
            if os.getppid() != args.parent:
                raise SystemExit(TERMINATED)


def tune(tuner: Tuner, study: str, args: argparse.Namespace, argv: Sequence[str]) -> FrozenTrial:
    """
    Start processes that train configurations, and print their progress.

    :param tuner: the study
    :param study: its name
    :param args: the command line
    :param argv: its arguments
    :return: the best trial
    :raises SystemExit: if no configuration was scored, or too few have ended
    """
    command = [sys.executable, "-m", "benchmark.tune", *argv, "--parent", str(os.getpid())]
    n_workers = args.workers if sum(map(has_ended, tuner.trials())) < args.trials else 0
    workers = start_workers(command, n_workers, args.threads, args.logs / study)
    with stopping(workers):
        printed = ""
        while any(worker.poll() is None for worker in workers):
            # Workers search for lost processes between their configurations only
            tuner.recover()
            progress = describe(tuner.trials(), args.trials)
            if progress != printed:
                print(f"{study}: {progress}", file=sys.stderr, flush=True)
                printed = progress
            time.sleep(INTERVAL)
            end_if_asked()
    trials = tuner.trials()
    best = best_of(trials)
    log = args.logs / study / "worker-*.log"
    if sum(map(has_ended, trials)) < args.trials:
        sys.exit(f"All processes have ended too early: {log} say why. The same command continues.")
    if best is None:
        sys.exit(f"No configuration was scored: {describe(trials, args.trials)}. {log} say why.")
    return best


def describe(trials: Sequence[FrozenTrial], n_trials: int) -> str:
    """
    Describe the progress of a study.

    :param trials: its trials
    :param n_trials: number of configurations that have to end
    :return: a line
    """
    ended = [trial for trial in trials if has_ended(trial)]
    n_pruned = sum(trial.state is TrialState.PRUNED for trial in ended)
    n_failed = sum(ERROR in trial.user_attrs for trial in ended)
    n_running = sum(trial.state is TrialState.RUNNING for trial in trials)
    best = best_of(trials)
    counts = f"{len(ended)} of {n_trials} configurations over ({n_pruned} pruned, {n_failed} failed), {n_running} running"
    return counts if best is None else f"{counts}, best {best.values[0]:.4g} (trial {best.number})"
