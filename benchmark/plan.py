"""
Plan a training run for ``make train`` before rl_zoo3 starts: the evaluation interval, and the number of the run.

``python -m benchmark.plan --algo cgp --env Pendulum-v1`` prints both on one line, as in ``250 1``.
"""

import argparse
import os
import sys
from collections.abc import Sequence

import gymnasium as gym
from huggingface_sb3 import EnvironmentName
from rl_zoo3 import ALGOS, get_latest_run_id

from benchmark.common.arguments import count
from benchmark.common.environments import import_packages, split_env_id
from benchmark.common.zoo import read_entry

EVALUATIONS_PER_RUN = 20
LONGEST_INTERVAL = 10_000


def configured_steps(algo: str, env_id: str) -> int:
    """
    Return the number of environment steps in the YAML file that rl_zoo3 would read.

    :param algo: the algorithm's name in rl_zoo3
    :param env_id: a registered environment
    :return: the number of environment steps
    """
    return int(read_entry(algo, env_id)["n_timesteps"])


def evaluation_interval(steps: int) -> int:
    """
    Return the interval that gives short runs a usable learning curve, and long ones the paper's.

    :param steps: the length of the run in environment steps
    :return: environment steps from one evaluation to the next
    """
    return min(max(steps // EVALUATIONS_PER_RUN, 1), LONGEST_INTERVAL)


def planned_interval(algo: str, env_id: str, steps: int | None) -> int:
    """
    Return the evaluation interval of a run that has not started.

    :param algo: the algorithm's name in rl_zoo3
    :param env_id: the environment
    :param steps: the number of environment steps; None for that of the YAML file
    :return: environment steps from one evaluation to the next
    """
    if steps is not None:
        return evaluation_interval(steps)
    # rl_zoo3.train suggests the nearest name, or knows the environment from --gym-packages
    if env_id not in gym.registry:
        return LONGEST_INTERVAL
    return evaluation_interval(configured_steps(algo, env_id))


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
    Print the evaluation interval and the next run's number.

    :param argv: the command line; None for that of the process
    """
    parser = argparse.ArgumentParser(prog="python -m benchmark.plan", description="Plan a training run of rl_zoo3.")
    parser.add_argument("--algo", default="cgp", choices=list(ALGOS), help="algorithm (default: %(default)s)")
    parser.add_argument("--env", default="Pendulum-v1", help="environment (default: %(default)s)")
    parser.add_argument("--folder", default="logs", help="rl_zoo3's log folder (default: %(default)s)")
    parser.add_argument("--steps", type=count, help="length of the run (default: that of the YAML file)")
    parser.add_argument("--gym-packages", nargs="+", default=[], help="modules to import, which register environments")
    args = parser.parse_args(argv)
    try:
        modules, env_id = split_env_id(args.env)
        if modules:
            # rl_zoo3.train looks for the whole id in the registry
            raise ValueError(
                f'rl_zoo3 does not import modules of ids: train ENV={env_id} with ARGS="--gym-packages {modules[0]}"'
            )
        import_packages(args.gym_packages)
    except (ImportError, ValueError) as error:
        sys.exit(f"Error: {error}")
    print(planned_interval(args.algo, args.env, args.steps), next_run_id(args.folder, args.algo, args.env))


if __name__ == "__main__":
    main()
