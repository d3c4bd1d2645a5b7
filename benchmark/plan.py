"""
Plan a training run for ``make train`` before rl_zoo3 starts: the evaluation interval, the number of the run, and the random
steps at the start of a shortened run.

``python -m benchmark.plan --algo cgp --env Pendulum-v1`` prints them on one line, as in ``1000 1``, or, with ``--steps 5000``,
as in ``250 1 learning_starts:500``.
"""

import argparse
import os
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
from huggingface_sb3 import EnvironmentName
from rl_zoo3 import ALGOS, get_latest_run_id

from benchmark.common.arguments import add_epilog, count
from benchmark.common.environments import import_packages, split_env_id
from benchmark.common.zoo import EVALUATIONS_PER_RUN, read_entry, shortened_warm_up, warm_up_in_words

LONGEST_INTERVAL = 10_000
# What to do in place of an option of rl_zoo3.train by which the run's final model is not where `make train` looks for it
REMEDIES = {
    "algo": "give ALGO={}",
    "env": "give ENV={}",
    "log_folder": "give LOGS={}",
    "uuid": "leave it out, as runs are numbered",
    "optimize_hyperparameters": "leave it out, and call rl_zoo3.train without make, as it trains no final model",
}


def configured_steps(entry: Mapping[str, Any]) -> int:
    """
    Return the number of environment steps of an entry.

    :param entry: the task's entry in the YAML file that rl_zoo3 would read
    :return: the number of environment steps
    :raises ValueError: if the entry has no such number
    """
    steps = entry.get("n_timesteps")
    try:
        return int(steps)  # type: ignore[arg-type]
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"The value of `n_timesteps` among the task's hyperparameters is {steps!r}, and must be a number of environment "
            "steps: correct the file of --conf-file"
        ) from error


def evaluation_interval(steps: int) -> int:
    """
    Return the interval that gives short runs a usable learning curve, and long ones the paper's.

    :param steps: the length of the run in environment steps
    :return: environment steps from one evaluation to the next
    """
    return min(max(steps // EVALUATIONS_PER_RUN, 1), LONGEST_INTERVAL)


def planned_interval(algo: str, env_id: str, steps: int | None, conf_file: str | None = None) -> int:
    """
    Return the evaluation interval of a run that has not started.

    :param algo: the algorithm's name in rl_zoo3
    :param env_id: the environment
    :param steps: the number of environment steps; None for that of the YAML file
    :param conf_file: a YAML file; None for the algorithm's own
    :return: environment steps from one evaluation to the next
    :raises ValueError: if the YAML file cannot be read, or has no number of steps for the environment
    """
    if steps is not None:
        return evaluation_interval(steps)
    # rl_zoo3.train suggests the nearest name, or knows the environment from --gym-packages
    if env_id not in gym.registry:
        return LONGEST_INTERVAL
    return evaluation_interval(configured_steps(read_entry(algo, env_id, conf_file)))


def planned_warm_up(algo: str, env_id: str, steps: int | None, options: argparse.Namespace) -> dict[str, int]:
    """
    Return the number of random steps of a run that is shorter than its YAML entry says, as in sweeps.

    :param algo: the algorithm's name in rl_zoo3
    :param env_id: the environment
    :param steps: the number of environment steps; None for that of the YAML file
    :param options: the options of rl_zoo3.train
    :return: ``learning_starts``; nothing if the user sets it, the run is not shortened, or at most a tenth is random anyway
    :raises ValueError: if the YAML file cannot be read, or has no number of steps for the environment
    """
    given = [hyperparameter.partition(":")[0] for hyperparameter in options.hyperparams]
    if steps is None or env_id not in gym.registry or "learning_starts" in given:
        return {}
    entry = read_entry(algo, env_id, options.conf_file)
    return shortened_warm_up(algo, entry, steps) if steps < configured_steps(entry) else {}


def train_options(arguments: Sequence[str]) -> argparse.Namespace:
    """
    Read those options of rl_zoo3.train that have an influence on the plan.

    :param arguments: the options, as in ``PARAMS`` and ``ARGS`` of ``make train``
    :return: the options
    :raises ValueError: if the run's final model would not be where ``make train`` looks for it; it names the option
    """
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("-params", "--hyperparams", nargs="+", default=[])
    parser.add_argument("-conf", "--conf-file")
    parser.add_argument("-n", "--n-timesteps", type=int, default=-1)
    parser.add_argument("--gym-packages", nargs="+", default=[])
    parser.add_argument("--algo")
    parser.add_argument("--env")
    parser.add_argument("-f", "--log-folder")
    parser.add_argument("-uuid", "--uuid", action="store_true", default=None)
    parser.add_argument("-optimize", "--optimize-hyperparameters", action="store_true", default=None)
    options = parser.parse_known_args(arguments)[0]
    for name, remedy in REMEDIES.items():
        value = getattr(options, name)
        if value is not None:
            option = f"--{name.replace('_', '-')}" + ("" if value is True else f" {value}")
            raise ValueError(f"`{option}` is no option that `make train` can pass on: {remedy.format(value)}")
    return options


def next_run_id(folder: str, algo: str, env_id: str) -> int:
    """
    Return the number that rl_zoo3 will give to the next run. By this number, a run can be reported although a later one has
    been started in the meantime.

    :param folder: rl_zoo3's log folder
    :param algo: the algorithm's name in rl_zoo3
    :param env_id: the environment
    :return: the run's number
    """
    return get_latest_run_id(os.path.join(folder, algo), EnvironmentName(env_id)) + 1


def main(argv: Sequence[str] | None = None) -> None:
    """
    Print the evaluation interval, the next run's number, and the random steps of a shortened run.

    :param argv: the command line; None for that of the process
    """
    parser = argparse.ArgumentParser(prog="python -m benchmark.plan", description="Plan a training run of rl_zoo3.")
    parser.add_argument("--algo", default="cgp", choices=list(ALGOS), help="algorithm (default: %(default)s)")
    parser.add_argument("--env", default="Pendulum-v1", help="environment (default: %(default)s)")
    parser.add_argument("--folder", default="logs", help="rl_zoo3's log folder (default: %(default)s)")
    parser.add_argument("--steps", type=count, help="length of the run (default: that of the YAML file)")
    parser.add_argument("--gym-packages", nargs="+", default=[], help="modules to import, which register environments")
    parser.add_argument("options", nargs="*", metavar="-- OPTION", help="other options of rl_zoo3.train")
    add_epilog(
        parser,
        "example:\n  python -m benchmark.plan --algo cgp --env Pendulum-v1 --steps 5000 -- -params batch_size:64",
        "It prints a line, and writes nothing.",
    )
    args = parser.parse_args(argv)
    try:
        options = train_options(args.options)
        # rl_zoo3 takes a negative number for the YAML file's
        steps = max(options.n_timesteps, 0) or args.steps
        modules, env_id = split_env_id(args.env)
        if modules:
            # rl_zoo3.train looks for the whole id in the registry
            raise ValueError(
                f'rl_zoo3 does not import modules of ids: train ENV={env_id} with ARGS="--gym-packages {modules[0]}"'
            )
        import_packages([*args.gym_packages, *options.gym_packages])
        warm_up = planned_warm_up(args.algo, args.env, steps, options)
        interval = planned_interval(args.algo, args.env, steps, options.conf_file)
    except (ImportError, ValueError) as error:
        sys.exit(f"Error: {error}")
    if warm_up:
        assert steps is not None
        print(warm_up_in_words(steps, **warm_up, remedy='PARAMS="learning_starts:..."'), file=sys.stderr)
    overrides = [f"{name}:{value}" for name, value in warm_up.items()]
    print(interval, next_run_id(args.folder, args.algo, args.env), *overrides)


if __name__ == "__main__":
    main()
