"""
What ``make train`` must know before rl_zoo3 starts: how often to evaluate, and which number the run will get.

``python -m benchmark.plan --algo cgp --env Pendulum-v1`` prints both on one line, as in ``250 1``.
"""

import argparse
import os
from collections.abc import Sequence
from contextlib import redirect_stdout

import gymnasium as gym
from huggingface_sb3 import EnvironmentName
from rl_zoo3 import ALGOS, get_latest_run_id
from rl_zoo3.exp_manager import ExperimentManager

from benchmark.common.arguments import count

EVALUATIONS_PER_RUN = 20
LONGEST_INTERVAL = 10_000


def configured_steps(algo: str, env_id: str) -> int:
    """
    Read how long rl_zoo3 would train, from the YAML file that it would read itself.

    :param algo: the algorithm's name in rl_zoo3
    :param env_id: a registered environment
    :return: the number of environment steps
    """
    manager = ExperimentManager(argparse.Namespace(), algo, env_id, log_folder="")
    # rl_zoo3 prints the hyperparameters that it reads, and prints them again when it trains
    with open(os.devnull, "w") as nowhere, redirect_stdout(nowhere):
        hyperparams, _ = manager.read_hyperparameters()
    return int(hyperparams["n_timesteps"])


def evaluation_interval(steps: int) -> int:
    """
    Choose an interval that gives short runs a usable learning curve and long ones the paper's.

    :param steps: the length of the run in environment steps
    :return: environment steps from one evaluation to the next
    """
    return min(max(steps // EVALUATIONS_PER_RUN, 1), LONGEST_INTERVAL)


def planned_interval(algo: str, env_id: str, steps: int | None) -> int:
    """
    Choose the evaluation interval of a run that has not started.

    :param algo: the algorithm's name in rl_zoo3
    :param env_id: the environment
    :param steps: the number of steps asked for; None for what the YAML file says
    :return: environment steps from one evaluation to the next
    """
    if steps is not None:
        return evaluation_interval(steps)
    # Not ours to refuse: rl_zoo3.train suggests the nearest name, or knows the environment from --gym-packages
    if env_id not in gym.registry:
        return LONGEST_INTERVAL
    return evaluation_interval(configured_steps(algo, env_id))


def next_run_id(folder: str, algo: str, env_id: str) -> int:
    """
    Tell the number that rl_zoo3 will give to the next run. With it, a run that ends
    can be reported although a later one has been started beside it.

    :param folder: rl_zoo3's log folder
    :param algo: the algorithm's name in rl_zoo3
    :param env_id: the environment
    :return: the run's number
    """
    return get_latest_run_id(os.path.join(folder, algo), EnvironmentName(env_id)) + 1


def main(argv: Sequence[str] | None = None) -> None:
    """
    Print the evaluation interval and the next run's number.

    :param argv: the command line; None for the process's own
    """
    parser = argparse.ArgumentParser(prog="python -m benchmark.plan", description="Plan a training run of rl_zoo3.")
    parser.add_argument("--algo", default="cgp", choices=list(ALGOS), help="algorithm (default: %(default)s)")
    parser.add_argument("--env", default="Pendulum-v1", help="environment (default: %(default)s)")
    parser.add_argument("--folder", default="logs", help="rl_zoo3's log folder (default: %(default)s)")
    parser.add_argument("--steps", type=count, help="length of the run (default: what the YAML file says)")
    args = parser.parse_args(argv)
    print(planned_interval(args.algo, args.env, args.steps), next_run_id(args.folder, args.algo, args.env))


if __name__ == "__main__":
    main()
