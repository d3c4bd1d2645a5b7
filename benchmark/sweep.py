"""
Execute a sweep, or continue it: ``python -m benchmark.sweep e3 --task Pendulum-v1 --steps 1000 --seeds 2 --workers 2``.

The runs are trials of an Optuna study. The same command, given again after any interruption, or on other machines with the
same ``--storage``, trains the runs that are left. At the end it exports the runs and draws the figures.
"""

import argparse
import sys
from collections.abc import Sequence

from benchmark.common.sweep_names import refuse_unknown_sweep

if __name__ == "__main__":
    # At once: the imports below take seconds
    refuse_unknown_sweep(sys.argv[1:])

from benchmark.common.arguments import add_epilog, add_hyperparameters, count, output_folder
from benchmark.common.zoo import warm_up_in_words
from benchmark.reporting.figures import FOLDER, figures, study_folders
from benchmark.sweeps.checks import check_values
from benchmark.sweeps.endings import errors_in_words
from benchmark.sweeps.execution import execute
from benchmark.sweeps.experiments import Sweep, experiments_in_words, included_sweeps, load_sweep, study_name
from benchmark.sweeps.groups import add_population
from benchmark.sweeps.processes import add_workers, check_grace, share_of_cores
from benchmark.sweeps.signals import handle_as_command
from benchmark.sweeps.storages import open_storage
from benchmark.sweeps.validation import SweepError

EXAMPLES = """\
examples:
  python -m benchmark.sweep e3 --methods CGP-Online QGP-Online --task Pendulum-v1 --steps 1000 --seeds 2 --workers 2
  python -m benchmark.sweep e4 --task Pendulum-v1 --steps 3000 --seeds 1 --set "policy_kwargs=dict(net_arch=[64, 64])"
  python -m benchmark.sweep mine.yml --workers 2"""
DURATION = """\
The first example takes ten minutes on two cores. With a million steps on HalfCheetah-v5, a run of CGP takes 6 to 12 hours on a
core of an AMD EPYC, and one of TD3 about two hours; e1 is 200 runs. --steps shortens runs; at most a tenth of a shortened run
is random, unless --set learning_starts=... sets the number. After an interruption, the same command continues."""
RESULTS = """\
The page results.md, the figures and the runs as text (STUDY/runs.jsonl) are written to --results, trained models and states to
--logs, and the study to --storage. This repository's own results are in benchmark/results/sweeps: see docs/experiments.md."""


def parse(argv: Sequence[str]) -> argparse.Namespace:
    """
    Read the command line.

    :param argv: the arguments
    :return: the parsed arguments
    """
    # No abbreviations: options that are not recorded are known by their whole names
    parser = argparse.ArgumentParser(
        prog="python -m benchmark.sweep", description="Execute a sweep, or continue it.", allow_abbrev=False
    )
    parser.add_argument(
        "name", help="a sweep of hyperparams/sweeps, such as e1 to e8 of the paper, or the path of a sweep's file"
    )
    parser.add_argument("--task", nargs="+", help="environments, as in Gymnasium, in place of the file's")
    parser.add_argument("--steps", type=count, help="environment steps of each run, in place of the file's")
    parser.add_argument("--seeds", type=count, help="number of seeds, from 0, in place of the file's")
    parser.add_argument("--methods", nargs="+", help="methods of the file to train (default: all)")
    add_hyperparameters(parser, "hyperparameters of all methods")
    parser.add_argument(
        "--eval-interval",
        type=count,
        help="environment steps between two evaluations (default: the file's, or a twentieth of --steps)",
    )
    parser.add_argument("--eval-episodes", type=count, help="episodes of each evaluation, in place of the file's")
    parser.add_argument("--study", help="the study's name (default: the sweep's, with the tasks if they were replaced)")
    add_workers(parser, "logs/sweeps")
    add_population(parser)
    parser.add_argument(
        "--results",
        type=output_folder,
        # argparse converts texts only
        default=str(FOLDER),
        help="folder of the results (default: %(default)s)",
    )
    parser.add_argument(
        "--adopt", action="store_true", help="take the ended runs that the folder of the results holds, trained elsewhere"
    )
    add_epilog(parser, EXAMPLES, experiments_in_words(), DURATION, RESULTS)
    args = parser.parse_args(argv)
    args.threads = args.threads or share_of_cores(args.workers)
    return args


def load(name: str, args: argparse.Namespace) -> Sweep:
    """
    Read a sweep with the changes of the command line.

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
        gym_packages=args.gym_packages,
    )
    return load_sweep(name, overrides, args.methods)


def main(argv: Sequence[str] | None = None) -> None:
    """
    Execute a sweep.

    :param argv: the command line; None for that of the process
    """
    argv = sys.argv[1:] if argv is None else argv
    args = parse(argv)
    handle_as_command()
    with errors_in_words(ValueError):
        check_grace(args.beat, args.grace)
        names = included_sweeps(args.name)
        sweeps = [load(name, args) for name in names]
        if args.study is not None and len(sweeps) > 1:
            raise SweepError("the command line", "--study", f"names one study, but {args.name} is {len(sweeps)} sweeps")
        studies = [study_name(sweep.name, args.study, args.task and sweep.file.tasks) for sweep in sweeps]
        storage = open_storage(args.storage)
        for sweep in sweeps:
            if warm_up := sweep.shortened_warm_up():
                print(warm_up_in_words(sweep.file.steps, **warm_up, remedy="--set learning_starts=..."), file=sys.stderr)
            print(f"Checking the hyperparameters of {sweep.name}", file=sys.stderr, flush=True)
            check_values(sweep)
        folders = [execute(sweep, storage, study, args, argv) for sweep, study in zip(sweeps, studies, strict=True)]
        print(f"The page is {figures(sorted({*folders, *study_folders(args.results)}), args.results)}")


if __name__ == "__main__":
    main()
