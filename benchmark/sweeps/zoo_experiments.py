"""rl_zoo3's managers of a sweep's runs, with the settings and the files that its other scripts read."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import yaml
from rl_zoo3 import ALGOS
from rl_zoo3.exp_manager import ExperimentManager
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from benchmark.sweeps.runs import Run
from sb3_cgp.common.files import write_atomically
from sb3_cgp.resumption.store import NoStateLeftError
from sb3_cgp.zoo.checkpoints import without_checkpoints

# The file of the hyperparameters, in the folder of the environment's name
ZOO_CONFIG = "*/config.yml"

Experiment = TypeVar("Experiment", bound=ExperimentManager)


def has_settings(folder: Path) -> bool:
    """
    Return whether a folder holds the hyperparameters that rl_zoo3 saved when a run began.

    :param folder: the run's folder
    :return: whether the run can continue in the folder
    """
    return any(folder.glob(ZOO_CONFIG))


def resumed_experiment(kind: Callable[..., Experiment], run: Run, folder: Path, device: str) -> Experiment:
    """
    Return rl_zoo3's manager of a run that continues.

    :param kind: the manager's class, ``ResumedExperiment`` or a subclass
    :param run: the run
    :param folder: the run's folder
    :param device: device of the networks
    :return: the manager
    :raises NoStateLeftError: if the folder does not hold the hyperparameters that rl_zoo3 saved when the run began
    """
    if not has_settings(folder):
        raise NoStateLeftError(f"{folder} has no {ZOO_CONFIG}, which rl_zoo3 saves when a run begins")
    (saved,) = folder.glob(ZOO_CONFIG)
    return kind(folder, _arguments(run, folder, device), dict(yaml.load(saved.read_text(), Loader=yaml.UnsafeLoader)))


def new_experiment(kind: Callable[..., Experiment], run: Run, folder: Path, device: str) -> Experiment:
    """
    Return rl_zoo3's manager of a run that starts.

    :param kind: the manager's class, ``ExperimentManager`` or a subclass
    :param run: the run
    :param folder: the run's folder
    :param device: device of the networks
    :return: the manager
    """
    args = _arguments(run, folder, device)
    manager = kind(
        args,
        run.algo,
        run.task,
        args.log_folder,
        n_timesteps=run.steps,
        eval_freq=run.evaluation_interval,
        n_eval_episodes=run.evaluation_episodes,
        log_interval=args.log_interval,
        config=args.conf_file,
        seed=run.seed,
        verbose=0,
        device=device,
    )
    manager.save_path = str(folder)
    manager.params_path = f"{folder}/{manager.env_name}"
    return manager


def _hyperparams(run: Run) -> dict[str, Any]:
    """Return the hyperparameters with one callback that saves training states, this one, if the algorithm has them."""
    hyperparams: dict[str, Any] = {"n_timesteps": run.steps, **run.hyperparams}
    if issubclass(ALGOS[run.algo], OffPolicyAlgorithm):
        saving = {"sb3_cgp.resumption.callbacks.TrainingCheckpointCallback": {"save_freq": run.checkpoint_interval, "keep": 1}}
        # A tuning's entry, such as CGP's, may save states, too
        hyperparams["callback"] = [*without_checkpoints(run.hyperparams.get("callback")), saving]
    return hyperparams


def _arguments(run: Run, folder: Path, device: str) -> argparse.Namespace:
    """Return the arguments of rl_zoo3.train for the run: rl_zoo3's other scripts and a resumption read them."""
    conf_file = folder / "hyperparams.yml"
    write_atomically(conf_file, yaml.safe_dump({run.task: _hyperparams(run)}).encode())
    return argparse.Namespace(
        algo=run.algo,
        env=run.task,
        seed=run.seed,
        conf_file=str(conf_file),
        device=device,
        # `rl_zoo3.enjoy` takes those of the hyperparameters then
        env_kwargs=None,
        eval_env_kwargs=None,
        eval_episodes=run.evaluation_episodes,
        eval_freq=run.evaluation_interval,
        gym_packages=run.gym_packages,
        hyperparams=None,
        # Of the whole configuration, as --folder takes it
        log_folder=str(folder.parent.parent),
        log_interval=-1,
        n_eval_envs=1,
        n_timesteps=run.steps,
        num_threads=-1,
        progress=False,
        save_freq=-1,
        save_replay_buffer=False,
        tensorboard_log="",
        trained_agent="",
        vec_env="dummy",
        verbose=0,
    )
