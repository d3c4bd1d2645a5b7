"""
Report on one training run of rl_zoo3: final evaluation, learning curve, and a record of both.

``python -m benchmark.report --algo cgp --env Pendulum-v1`` takes the latest run, evaluates its final model,
and writes ``learning_curve.png`` and ``report.json`` into the run's folder.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from rl_zoo3 import ALGOS

from benchmark.common.arguments import add_epilog, count, natural, seed
from benchmark.common.environments import import_packages, split_env_id
from benchmark.common.records import EVALUATION_SEED
from benchmark.reporting.run_reports import report, summary
from benchmark.reporting.zoo_runs import find_run, run_in


def main(argv: Sequence[str] | None = None) -> None:
    """
    Report on the run that the command line names.

    :param argv: the command line; None for that of the process
    """
    parser = argparse.ArgumentParser(prog="python -m benchmark.report", description="Report on a training run of rl_zoo3.")
    parser.add_argument("--algo", default="cgp", choices=list(ALGOS), help="algorithm (default: %(default)s)")
    parser.add_argument("--env", default="Pendulum-v1", help="environment (default: %(default)s)")
    parser.add_argument("--folder", default="logs", help="rl_zoo3's log folder (default: %(default)s)")
    parser.add_argument("--exp-id", default=0, type=natural, help="number of the run (default: 0, the latest)")
    parser.add_argument("--run", type=Path, help="the run's folder, in place of the four above")
    parser.add_argument("--episodes", default=20, type=count, help="episodes of the final evaluation (default: %(default)s)")
    parser.add_argument(
        "--seed", default=EVALUATION_SEED, type=seed, help="seed of the final evaluation (default: %(default)s)"
    )
    add_epilog(
        parser,
        "examples:\n"
        "  python -m benchmark.report --algo cgp --env Pendulum-v1\n"
        "  python -m benchmark.report --run logs/cgp/Pendulum-v1_1 --episodes 100",
        "It takes the time of the episodes, seconds to a minute. learning_curve.png and report.json are written to the\n"
        "run's folder.",
    )
    args = parser.parse_args(argv)
    try:
        import_packages(split_env_id(args.env)[0])
        run = run_in(args.run) if args.run else find_run(args.folder, args.algo, args.env, args.exp_id)
        for name in ("args.yml", "config.yml"):
            # Before anything is evaluated
            run.read_yaml(name)
    except (FileNotFoundError, ImportError, ValueError) as error:
        sys.exit(f"Error: {error}")
    print(summary(run, report(run, args.episodes, args.seed)))


if __name__ == "__main__":
    main()
