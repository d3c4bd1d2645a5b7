"""One run of a sweep, trained by rl_zoo3 in a folder of its own, and continued from its last state if it has one."""

import json
import math
import shutil
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch as th
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
from benchmark.sweeps.zoo_experiments import new_experiment, resumed_experiment
from sb3_cgp.common.files import write_atomically
from sb3_cgp.resumption.algorithm import resumable
from sb3_cgp.resumption.store import NoStateLeftError, StateStore
from sb3_cgp.zoo.folders import state_folder
from sb3_cgp.zoo.registration import register
from sb3_cgp.zoo.resumed_run import ResumedExperiment

# The file in a run's folder with the run that its states belong to
RUN_FILE = "run.json"
# Errors that may be no fault of the run: of the database, a simulator's connection, the disk, a missing package, too little
# memory, or a GPU, which no training of the same process can use after such an error
MACHINE_ERRORS = (
    *(*STORAGE_ERRORS, OSError, ImportError, DependencyNotInstalled, MemoryError, th.OutOfMemoryError, th.AcceleratorError),
)


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
    register_all(run)
    begin(run, folder)
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


def register_all(run: Run) -> None:
    """
    Register the algorithms and the environments that a run may need.

    :param run: the run
    """
    register()
    register_random_actions()
    import_packages(run.gym_packages)


def forget_states(folder: Path) -> None:
    """
    Remove the states that a run would continue from.

    :param folder: the run's folder
    """
    shutil.rmtree(state_folder(str(folder)), ignore_errors=True)


def has_state(run: Run, folder: Path) -> bool:
    """
    Return whether a run would continue from a state.

    :param run: the run
    :param folder: the run's folder
    :return: whether the folder holds states, and they are the run's own
    """
    return _is_of(run, folder) and len(StateStore(state_folder(str(folder))).steps()) > 0


def _is_of(run: Run, folder: Path) -> bool:
    path = folder / RUN_FILE
    return path.is_file() and path.read_bytes() == _run_as_json(run)


def _run_as_json(run: Run) -> bytes:
    return json.dumps(asdict(run)).encode()


def begin(run: Run, folder: Path) -> None:
    """
    Make a folder a run's own: a run does not continue states that a study of the same name has left there.

    :param run: the run
    :param folder: the run's folder
    :raises FileExistsError: if the folder holds a run on another environment
    """
    path = folder / RUN_FILE
    if not _is_of(run, folder):
        other = json.loads(path.read_bytes()) if path.is_file() else {}
        if other.get("task", run.task) != run.task:
            # rl_zoo3 gives both environments the same name
            raise FileExistsError(
                f"{folder} holds a run on {other['task']}, and would hold one on {run.task}: choose another name by --study, "
                "or another folder by --logs"
            )
        forget_states(folder)
        write_atomically(path, _run_as_json(run))


def _set_up(run: Run, folder: Path, device: str) -> tuple[ExperimentManager, BaseAlgorithm]:
    set_random_seed(run.seed)
    ALGOS[run.algo] = _with_states(ALGOS[run.algo])
    if StateStore(state_folder(str(folder))).steps():
        manager: ExperimentManager = resumed_experiment(ResumedExperiment, run, folder, device)
    else:
        manager = new_experiment(ExperimentManager, run, folder, device)
    model, _ = manager.setup_experiment()  # type: ignore[misc]
    return manager, model


def _with_states(algorithm: type[BaseAlgorithm]) -> type[BaseAlgorithm]:
    return resumable(algorithm) if issubclass(algorithm, OffPolicyAlgorithm) else algorithm


def _final_return(model: BaseAlgorithm, evaluation: EvalCallback) -> float:
    """Return the mean return of the final model; that of an offline variant differs from the one evaluated last."""
    env = evaluation.eval_env
    assert model.env is not None
    sync_envs_normalization(model.env, env)
    env.seed(EVALUATION_SEED)
    returns, _ = evaluate_policy(model, env, FINAL_EPISODES, deterministic=evaluation.deterministic)
    env.close()
    return float(np.mean(returns))
