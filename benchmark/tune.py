"""
Tune hyperparameters, each configuration by several seeds: ``python -m benchmark.tune --algo cgp --env Pendulum-v1``.

The same command, given again after any interruption, or on other machines with the same ``--storage``, continues until
``--trials`` configurations have ended, and writes the best with ``--write hyperparams/mine.yml``.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import optuna
import torch as th
from rl_zoo3.hyperparams_opt import HYPERPARAMS_SAMPLER

from benchmark.common.arguments import add_epilog, add_hyperparameters, count
from benchmark.common.environments import import_packages, registered_environment, split_env_id
from benchmark.common.zoo import shortened_warm_up, warm_up_in_words
from benchmark.sweeps.checks import check_tuning
from benchmark.sweeps.endings import errors_in_words
from benchmark.sweeps.entries import base_entry, check_file, write_entry
from benchmark.sweeps.experiments import study_name
from benchmark.sweeps.processes import add_workers, check_grace, share_of_cores
from benchmark.sweeps.runs import checkpoint_interval
from benchmark.sweeps.scoring import PRUNERS, SCORING
from benchmark.sweeps.signals import handle_as_command, handle_as_worker
from benchmark.sweeps.storages import open_storage, patiently
from benchmark.sweeps.tune_execution import execute_trials, tune
from benchmark.sweeps.tuner import Tuner
from benchmark.sweeps.tuning import SCORES, Tuning
from sb3_cgp.zoo.registration import register

EXAMPLES = """\
examples:
  python -m benchmark.tune --algo cgp --env Pendulum-v1 --steps 5000 --seeds 2 --trials 10 --workers 2 --write mine.yml
  python -m rl_zoo3.train --algo cgp --env Pendulum-v1 --conf-file mine.yml"""
DURATION = """\
It takes at most the time of --seeds times --trials runs, divided by --workers: the example up to 20 runs of 5,000 steps, of
one to a few minutes each. At most a tenth of a shortened run is random, unless --set learning_starts=... sets the number.
After an interruption, the same command continues."""
RESULTS = """\
The best configuration is printed, and written to the file of --write. Runs lie in --logs, and the study in --storage, for
optuna-dashboard."""


def parse(argv: Sequence[str]) -> argparse.Namespace:
    """
    Read the command line.

    :param argv: the arguments
    :return: the parsed arguments
    """
    register()
    parser = argparse.ArgumentParser(
        prog="python -m benchmark.tune", description="Tune hyperparameters by several seeds.", allow_abbrev=False
    )
    parser.add_argument("--algo", required=True, choices=sorted(HYPERPARAMS_SAMPLER), help="the algorithm, as in rl_zoo3")
    parser.add_argument("--env", required=True, help="the environment, as in Gymnasium")
    parser.add_argument("--steps", type=count, help="environment steps of each run (default: the YAML entry's)")
    parser.add_argument("--seeds", type=count, default=3, help="runs of each configuration (default: %(default)s)")
    parser.add_argument("--trials", type=count, default=50, help="configurations in all (default: %(default)s)")
    parser.add_argument(
        "--score", choices=sorted(SCORING), default="mean", help="statistic of the seeds' final returns (default: %(default)s)"
    )
    parser.add_argument(
        "--pruner", choices=sorted(PRUNERS), default="median", help="rule for giving a configuration up (default: %(default)s)"
    )
    parser.add_argument("--conf-file", help="YAML file of the entry that configurations start from (default: the algorithm's)")
    add_hyperparameters(parser, "hyperparameters that replace sampled ones")
    parser.add_argument("--eval-interval", type=count, help="environment steps between two evaluations")
    parser.add_argument("--eval-episodes", type=count, default=5, help="episodes of each (default: %(default)s)")
    parser.add_argument("--write", type=Path, help="a YAML file of rl_zoo3's, for the best configuration")
    parser.add_argument("--study", help="the study's name (default: tune, the algorithm and the environment)")
    add_workers(parser, "logs/tuning")
    parser.add_argument("--parent", type=int, help=argparse.SUPPRESS)
    add_epilog(parser, EXAMPLES, DURATION, RESULTS)
    args = parser.parse_args(argv)
    args.threads = args.threads or share_of_cores(args.workers)
    return args


def tuning_of(args: argparse.Namespace) -> Tuning:
    """
    Return the tuning of a command line.

    :param args: the command line
    :return: the tuning
    :raises ValueError: if the environment is not registered, or has no hyperparameters to start from
    """
    packages, _ = split_env_id(args.env)
    task = registered_environment(args.env)
    base = base_entry(args.algo, task, args.conf_file)
    usual = int(base.get("n_timesteps", 0))
    steps = args.steps or usual
    if not steps:
        raise ValueError(f"The hyperparameters of {args.algo} for {task} have no n_timesteps: give --steps")
    if steps < usual:
        shortened = shortened_warm_up(args.algo, base, steps)
        base |= shortened
        if shortened and args.parent is None and "learning_starts" not in dict(args.set):
            print(warm_up_in_words(steps, **shortened, remedy="--set learning_starts=..."), file=sys.stderr)
    return Tuning(
        algo=args.algo,
        task=task,
        base=base,
        fixed=dict(args.set),
        steps=steps,
        seeds=args.seeds,
        score=args.score,
        pruner=args.pruner,
        evaluation_interval=args.eval_interval or max(steps // 10, 1),
        evaluation_episodes=args.eval_episodes,
        checkpoint_interval=checkpoint_interval(steps),
        gym_packages=[*args.gym_packages, *packages],
    )


def main(argv: Sequence[str] | None = None) -> None:
    """
    Tune hyperparameters.

    :param argv: the command line; None for that of the process
    """
    argv = sys.argv[1:] if argv is None else argv
    args = parse(argv)
    if args.parent is None:
        handle_as_command()
    else:
        handle_as_worker(args.parent)
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    with errors_in_words(ValueError, ImportError):
        check_grace(args.beat, args.grace)
        import_packages(args.gym_packages)
        tuning = tuning_of(args)
        if args.write is not None:
            # Before the tuning, whose result would be lost
            check_file(args.write, tuning.task)
        study = study_name(f"tune-{args.algo}", args.study, [tuning.task])
        storage = open_storage(args.storage) if args.parent is None else patiently(open_storage, args.storage)
        if args.parent is None:
            # Before the study notes the settings
            check_tuning(tuning)
        tuner = Tuner(storage, study, tuning, args.grace)
        if args.parent is not None:
            th.set_num_threads(args.threads)
            execute_trials(tuner, args)
            return
        best = tune(tuner, study, args, argv)
        entry = tuning.entry(best)
        scores = ", ".join(f"{score:.4g}" for score in best.user_attrs[SCORES])
        summary = f"benchmark.tune, trial {best.number}: {args.score} of {args.seeds} seeds {best.values[0]:.4g} ({scores})"
        summary += ", which selected it and overestimate it: compare with other seeds"
        print(summary, *(f"  {name}: {value!r}" for name, value in sorted(entry.items())), sep="\n")
        if args.write is not None:
            write_entry(args.write, tuning.task, entry, summary)


if __name__ == "__main__":
    main()
