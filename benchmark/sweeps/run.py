"""One run of a sweep, trained by rl_zoo3 in a folder of its own, and continued from its last state if it has one."""

import argparse
import json
import math
import shutil
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
import yaml
from gymnasium.error import DependencyNotInstalled
from huggingface_sb3 import EnvironmentName
from rl_zoo3 import ALGOS
from rl_zoo3.exp_manager import ExperimentManager
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import sync_envs_normalization

from benchmark.common.environments import import_packages
from benchmark.common.files import file_name
from benchmark.common.records import EVALUATION_SEED, FINAL_EPISODES
from benchmark.sweeps.random_actions import register_random_actions
from benchmark.sweeps.reporter import Report, Reporter
from benchmark.sweeps.runs import Run
from benchmark.sweeps.storages import STORAGE_ERRORS
from sb3_cgp.common.files import write_atomically
from sb3_cgp.resumption.algorithm import resumable
from sb3_cgp.resumption.store import NoStateLeftError, StateStore
from sb3_cgp.zoo.folders import state_folder
from sb3_cgp.zoo.registration import register
from sb3_cgp.zoo.resumed_run import ResumedExperiment

# The file in a run's folder with the run that its states belong to
SETTINGS = "run.json"
# Errors that are no fault of the run: of the database, the disk, a missing package, or too little memory
MACHINE_ERRORS = (*STORAGE_ERRORS, OSError, ImportError, DependencyNotInstalled, MemoryError, th.OutOfMemoryError)


def run_folder(logs: Path, study: str, run: Run) -> Path:
    """
    Return the folder of a run, which rl_zoo3's scripts find with ``--folder logs/study/configuration``.

    :param logs: the folder of all sweeps
    :param study: the study's name
    :param run: the run
    :return: the run's folder
    """
    # rl_zoo3 numbers runs from 1
    return logs / study / file_name(run.configuration) / run.algo / f"{EnvironmentName(run.task)}_{run.seed + 1}"


def train(run: Run, folder: Path, report: Report, watch: Callable[[int], None], device: str = "auto") -> float:
    """
    Train a run to its end, from its last state if it has one.

    :param run: the run
    :param folder: the run's folder
    :param report: receives each evaluation, also those before the state that the run continues from
    :param watch: receives the environment steps at every step, and may raise
    :param device: device of the networks
    :return: mean return of the final model over episodes that are the same for all runs of a task
    :raises FloatingPointError: if the mean return is not finite
    :raises FileExistsError: if the folder holds a run on another environment
    """
    register()
    register_random_actions()
    import_packages(run.gym_packages)
    _begin(run, folder)
    try:
        manager, model = _set_up(run, folder, device)
    except NoStateLeftError as error:
        print(f"{run.key} starts from the beginning: {error}", flush=True)
        forget_states(folder)
        manager, model = _set_up(run, folder, device)
    (evaluation,) = (each for each in manager.callbacks if isinstance(each, EvalCallback))
    manager.callbacks.append(Reporter(evaluation, report, watch))
    manager.learn(model)
    manager.save_trained_model(model)
    final = _final_return(model, evaluation)
    if not math.isfinite(final):
        raise FloatingPointError(f"The final model's mean return is {final}")
    return final


def forget_states(folder: Path) -> None:
    """
    Remove the states that a run would continue from.

    :param folder: the run's folder
    """
    shutil.rmtree(state_folder(str(folder)), ignore_errors=True)


def _begin(run: Run, folder: Path) -> None:
    """Remove the states of another run, which a study of the same name has left there: this run does not continue them."""
    settings = json.dumps(asdict(run)).encode()
    path = folder / SETTINGS
    if not path.is_file() or path.read_bytes() != settings:
        other = json.loads(path.read_bytes()) if path.is_file() else {}
        if other.get("task", run.task) != run.task:
            # rl_zoo3 gives both environments the same name
            raise FileExistsError(
                f"{folder} holds a run on {other['task']}, and would hold one on {run.task}: choose another name by --study, "
                "or another folder by --logs"
            )
        forget_states(folder)
        write_atomically(path, settings)


def _set_up(run: Run, folder: Path, device: str) -> tuple[ExperimentManager, BaseAlgorithm]:
    set_random_seed(run.seed)
    manager = _manager(run, folder, device)
    model, _ = manager.setup_experiment()  # type: ignore[misc]
    return manager, model


def _manager(run: Run, folder: Path, device: str) -> ExperimentManager:
    """Return rl_zoo3's manager of a run that starts or continues."""
    ALGOS[run.algo] = _with_states(ALGOS[run.algo])
    args = _arguments(run, folder, device)
    if StateStore(state_folder(str(folder))).steps():
        # With the hyperparameters of the algorithm's YAML file
        (saved,) = folder.glob("*/config.yml")
        return ResumedExperiment(folder, args, dict(yaml.load(saved.read_text(), Loader=yaml.UnsafeLoader)))
    manager = ExperimentManager(
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
        hyperparams=_hyperparams(run) if run.tuned else None,
    )
    manager.save_path = str(folder)
    manager.params_path = f"{folder}/{manager.env_name}"
    return manager


def _with_states(algorithm: type[BaseAlgorithm]) -> type[BaseAlgorithm]:
    return resumable(algorithm) if issubclass(algorithm, OffPolicyAlgorithm) else algorithm


def _hyperparams(run: Run) -> dict[str, Any]:
    """Return the hyperparameters with the callback that saves training states, if the algorithm has them."""
    hyperparams: dict[str, Any] = {"n_timesteps": run.steps, **run.hyperparams}
    if issubclass(ALGOS[run.algo], OffPolicyAlgorithm):
        saving = {"sb3_cgp.resumption.callbacks.TrainingCheckpointCallback": {"save_freq": run.checkpoint_interval, "keep": 1}}
        # rl_zoo3 takes one callback, or a list of them
        own = run.hyperparams.get("callback") or []
        hyperparams["callback"] = [*(own if isinstance(own, list) else [own]), saving]
    return hyperparams


def _arguments(run: Run, folder: Path, device: str) -> argparse.Namespace:
    """Return the arguments of rl_zoo3.train for the run: rl_zoo3's other scripts and a resumption read them."""
    conf_file = None
    if not run.tuned:
        conf_file = folder / "hyperparams.yml"
        write_atomically(conf_file, yaml.safe_dump({run.task: _hyperparams(run)}).encode())
    return argparse.Namespace(
        algo=run.algo,
        env=run.task,
        seed=run.seed,
        conf_file=None if conf_file is None else str(conf_file),
        device=device,
        env_kwargs={},
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


def _final_return(model: BaseAlgorithm, evaluation: EvalCallback) -> float:
    """Return the mean return of the final model; that of an offline variant differs from the one evaluated last."""
    env = evaluation.eval_env
    assert model.env is not None
    sync_envs_normalization(model.env, env)
    env.seed(EVALUATION_SEED)
    returns, _ = evaluate_policy(model, env, FINAL_EPISODES, deterministic=evaluation.deterministic)
    env.close()
    return float(np.mean(returns))
