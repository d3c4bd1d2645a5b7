"""
Tunes hyperparameters, each configuration by several seeds: ``python -m benchmark.tune --algo cgp --env Pendulum-v1``.

The same command, given again after whatever interruption, or on other machines with the same ``--storage``, goes on until
``--trials`` configurations are over, and writes the best with ``--write hyperparams/mine.yml``.
"""

import argparse
import os
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import optuna
import torch as th
from optuna.trial import FrozenTrial, TrialState
from rl_zoo3.hyperparams_opt import HYPERPARAMS_SAMPLER

from benchmark.common.arguments import count, hyperparameter
from benchmark.sweeps.entries import base_entry, write_entry
from benchmark.sweeps.processes import (
    TERMINATED,
    add_workers,
    listen,
    see_that_grace_is_longer,
    share_of_cores,
    start_workers,
    stop,
    terminate,
)
from benchmark.sweeps.storages import STORAGE_ERRORS, open_storage, patiently, reason_of
from benchmark.sweeps.studies import ERROR
from benchmark.sweeps.sweep_files import SweepError, known_task
from benchmark.sweeps.tuning import PRUNERS, SCORES, SCORING, Tuner, Tuning, best_of, is_over
from benchmark.worker import PAUSE
from sb3_cgp.zoo.registration import register

# Seconds between two looks at the study
LOOK = 2.0


def tuning_of(args: argparse.Namespace) -> Tuning:
    """
    Make what is tuned of a command line.

    :param args: the command line
    :return: what is tuned
    :raises ValueError: if the task is unknown, or has no hyperparameters to start from
    """
    base = base_entry(args.algo, known_task(args.env), args.conf_file)
    steps = args.steps or int(base["n_timesteps"])
    return Tuning(
        algo=args.algo,
        task=args.env,
        base=base,
        fixed=dict(args.set),
        steps=steps,
        seeds=args.seeds,
        score=args.score,
        pruner=args.pruner,
        evaluation_interval=args.eval_interval or max(steps // 10, 1),
        evaluation_episodes=args.eval_episodes,
        checkpoint_interval=min(max(steps // 10, 1_000), 10_000),
    )


def work(tuner: Tuner, args: argparse.Namespace) -> None:
    """
    Try configurations until enough are over.

    :param tuner: the study
    :param args: the command line
    :raises SystemExit: if the process is asked to end; its trial is given back
    """
    while True:
        tuner.recover()
        trials = tuner.trials()
        n_over = sum(map(is_over, trials))
        n_running = sum(trial.state is TrialState.RUNNING for trial in trials)
        if n_over >= args.trials:
            return
        if n_over + n_running < args.trials or any(trial.state is TrialState.WAITING for trial in trials):
            tuner.attempt(args.logs, args.beat, args.parent, args.device)
        else:
            # Others' trials, or those of processes that have not been silent for long enough
            time.sleep(PAUSE)
            if os.getppid() != args.parent:
                raise SystemExit(TERMINATED)


def conduct(tuner: Tuner, study: str, args: argparse.Namespace, argv: Sequence[str]) -> FrozenTrial:
    """
    Let processes of this machine work, and tell how far they are.

    :param tuner: the study
    :param study: its name
    :param args: the command line
    :param argv: its arguments
    :return: the best trial
    :raises SystemExit: if there is none, or too few are over
    """
    workers = []
    try:
        if sum(map(is_over, tuner.trials())) < args.trials:
            command = [sys.executable, "-m", "benchmark.tune", *argv, "--parent", str(os.getpid())]
            workers = start_workers(command, args.workers, args.threads, args.logs / study)
        told = ""
        while any(worker.poll() is None for worker in workers):
            # Workers look for lost processes between their configurations only
            tuner.recover()
            standing = describe(tuner.trials(), args.trials)
            if standing != told:
                print(f"{study}: {standing}", file=sys.stderr, flush=True)
                told = standing
            time.sleep(LOOK)
    except BaseException:
        stop(workers)
        print("Stopped. The same command goes on.", file=sys.stderr)
        raise
    trials = tuner.trials()
    best = best_of(trials)
    log = args.logs / study / "worker-*.log"
    if sum(map(is_over, trials)) < args.trials:
        sys.exit(f"All processes have ended too early: {log} say why. The same command goes on.")
    if best is None:
        sys.exit(f"No configuration was scored: {describe(trials, args.trials)}. {log} say why.")
    return best


def describe(trials: Sequence[FrozenTrial], n_trials: int) -> str:
    """
    Tell how far a study is.

    :param trials: its trials
    :param n_trials: how many are to be over
    :return: a line
    """
    over = [trial for trial in trials if is_over(trial)]
    n_pruned = sum(trial.state is TrialState.PRUNED for trial in over)
    n_failed = sum(ERROR in trial.user_attrs for trial in over)
    n_running = sum(trial.state is TrialState.RUNNING for trial in trials)
    best = best_of(trials)
    counts = f"{len(over)} of {n_trials} configurations over ({n_pruned} pruned, {n_failed} failed), {n_running} running"
    return counts if best is None else f"{counts}, best {best.values[0]:.4g} (trial {best.number})"


def parse(argv: Sequence[str]) -> argparse.Namespace:
    """
    Read the command line.

    :param argv: the arguments
    :return: what they say
    """
    register()
    parser = argparse.ArgumentParser(
        prog="python -m benchmark.tune", description="Tune hyperparameters by several seeds.", allow_abbrev=False
    )
    parser.add_argument("--algo", required=True, choices=sorted(HYPERPARAMS_SAMPLER), help="the algorithm, as in rl_zoo3")
    parser.add_argument("--env", required=True, help="the environment")
    parser.add_argument("--steps", type=count, help="environment steps of each run (default: the YAML entry's)")
    parser.add_argument("--seeds", type=count, default=3, help="runs of each configuration (default: %(default)s)")
    parser.add_argument("--trials", type=count, default=50, help="configurations in all (default: %(default)s)")
    parser.add_argument(
        "--score", choices=sorted(SCORING), default="mean", help="of the seeds' final returns (default: %(default)s)"
    )
    parser.add_argument(
        "--pruner", choices=sorted(PRUNERS), default="median", help="what gives a configuration up (default: %(default)s)"
    )
    parser.add_argument("--conf-file", help="what to start from (default: the algorithm's YAML file)")
    parser.add_argument(
        "--set", nargs="+", type=hyperparameter, default=[], metavar="NAME=VALUE", help="in place of what is sampled"
    )
    parser.add_argument("--eval-interval", type=count, help="environment steps between two evaluations")
    parser.add_argument("--eval-episodes", type=count, default=5, help="episodes of each (default: %(default)s)")
    parser.add_argument("--write", type=Path, help="a YAML file of rl_zoo3's, for the best configuration")
    parser.add_argument("--study", help="the study's name (default: tune, the algorithm and the environment)")
    add_workers(parser, "logs/tuning")
    parser.add_argument("--parent", type=int, help=argparse.SUPPRESS)
    args = parser.parse_args(argv)
    args.threads = args.threads or share_of_cores(args.workers)
    return args


def main(argv: Sequence[str] | None = None) -> None:
    """
    Tune.

    :param argv: the command line; None for the process's own
    """
    argv = sys.argv[1:] if argv is None else argv
    args = parse(argv)
    if args.parent is None:
        signal.signal(signal.SIGTERM, terminate)
    else:
        listen(args.parent)
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = args.study or f"tune-{args.algo}-{args.env}"
    try:
        see_that_grace_is_longer(args.beat, args.grace)
        tuning = tuning_of(args)
        storage = open_storage(args.storage) if args.parent is None else patiently(open_storage, args.storage)
        tuner = Tuner(storage, study, tuning, args.grace)
        if args.parent is not None:
            th.set_num_threads(args.threads)
            work(tuner, args)
            return
        best = conduct(tuner, study, args, argv)
        entry = tuning.entry(best)
        scores = ", ".join(f"{score:.4g}" for score in best.user_attrs[SCORES])
        said = f"benchmark.tune, trial {best.number}: {args.score} of {args.seeds} seeds {best.values[0]:.4g} ({scores})"
        print(said, *(f"  {name}: {value!r}" for name, value in sorted(entry.items())), sep="\n")
        if args.write is not None:
            write_entry(args.write, args.env, entry, said)
    except (SweepError, ValueError) as error:
        sys.exit(f"Error: {error}")
    except STORAGE_ERRORS as error:
        sys.exit(f"Error: the storage does not answer: {reason_of(error)}. When it does, the same command goes on.")
    except KeyboardInterrupt:
        sys.exit(128 + signal.SIGINT)


if __name__ == "__main__":
    main()
