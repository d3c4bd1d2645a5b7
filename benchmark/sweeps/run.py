"""One run of a sweep, trained by rl_zoo3 in a folder of its own, and taken up again from its last state if there is one."""

import argparse
import json
import math
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
import yaml
from gymnasium.error import DependencyNotInstalled
from rl_zoo3 import ALGOS
from rl_zoo3.exp_manager import ExperimentManager
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import sync_envs_normalization

from benchmark.common.records import FINAL_EPISODES
from benchmark.report import EVALUATION_SEED
from benchmark.sweeps.experiments import Run
from benchmark.sweeps.random_actions import register_random_actions
from benchmark.sweeps.storages import STORAGE_ERRORS
from sb3_cgp.common.files import write_atomically
from sb3_cgp.resumption.algorithm import resumable
from sb3_cgp.resumption.store import NoStateLeftError, StateStore
from sb3_cgp.zoo.folders import state_folder
from sb3_cgp.zoo.registration import register
from sb3_cgp.zoo.resumed_run import ResumedExperiment

# What a run's states belong to, in its folder
SETTINGS = "run.json"
# What is no fault of a run's: the database, the disk, a package that is missing, too little memory
MACHINE_ERRORS = (*STORAGE_ERRORS, OSError, ImportError, DependencyNotInstalled, MemoryError, th.OutOfMemoryError)
# Takes environment steps and the mean return of an evaluation
Report = Callable[[int, float], None]


def run_folder(logs: Path, study: str, run: Run) -> Path:
    """
    Tell where a run lies: where rl_zoo3's scripts find it with ``--folder logs/study/configuration``.

    :param logs: the folder of all sweeps
    :param study: the study's name
    :param run: the run
    :return: the run's folder
    """
    # rl_zoo3 numbers runs from 1
    return logs / study / run.configuration / run.algo / f"{run.task}_{run.seed + 1}"


def train(run: Run, folder: Path, report: Report, watch: Callable[[int], None], device: str = "auto") -> float:
    """
    Train a run to its end, from its last state if there is one.

    :param run: the run
    :param folder: the run's folder
    :param report: is told each evaluation, also those before the state that the run is taken up from
    :param watch: is told the environment steps at every step, and may raise
    :param device: where the networks compute
    :return: mean return of the final model over episodes that are the same for all runs of a task
    :raises FloatingPointError: if that is no finite number
    """
    register()
    register_random_actions()
    _begin(run, folder)
    try:
        manager, model = _set_up(run, folder, device)
    except NoStateLeftError as error:
        print(f"{run.key} begins anew: {error}", flush=True)
        forget_states(folder)
        manager, model = _set_up(run, folder, device)
    (evaluation,) = (each for each in manager.callbacks if isinstance(each, EvalCallback))
    manager.callbacks.append(_Reporter(evaluation, report, watch))
    manager.learn(model)
    manager.save_trained_model(model)
    final = _final_return(model, evaluation)
    if not math.isfinite(final):
        raise FloatingPointError(f"The final model's mean return is {final}")
    return final


def forget_states(folder: Path) -> None:
    """
    Remove what a run would be taken up again from.

    :param folder: the run's folder
    """
    shutil.rmtree(state_folder(str(folder)), ignore_errors=True)


def _begin(run: Run, folder: Path) -> None:
    """See that no run is taken up from the states of another, which a study of the same name has left there."""
    settings = json.dumps(asdict(run)).encode()
    path = folder / SETTINGS
    if not path.is_file() or path.read_bytes() != settings:
        forget_states(folder)
        write_atomically(path, settings)


def _set_up(run: Run, folder: Path, device: str) -> tuple[ExperimentManager, BaseAlgorithm]:
    set_random_seed(run.seed)
    manager = _manager(run, folder, device)
    model, _ = manager.setup_experiment()  # type: ignore[misc]
    return manager, model


def _manager(run: Run, folder: Path, device: str) -> ExperimentManager:
    """Make rl_zoo3's manager of a run that starts, or goes on."""
    ALGOS[run.algo] = _with_states(ALGOS[run.algo])
    args = _arguments(run, folder, device)
    if StateStore(state_folder(str(folder))).steps():
        # Those of the algorithm's YAML file among them
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
    """Complete the hyperparameters by what saves the training's state, where the algorithm's can be saved."""
    hyperparams: dict[str, Any] = {"n_timesteps": run.steps, **run.hyperparams}
    if issubclass(ALGOS[run.algo], OffPolicyAlgorithm):
        saving = {"sb3_cgp.resumption.callbacks.TrainingCheckpointCallback": {"save_freq": run.checkpoint_interval, "keep": 1}}
        # rl_zoo3 takes one callback, or a list of them
        own = run.hyperparams.get("callback") or []
        hyperparams["callback"] = [*(own if isinstance(own, list) else [own]), saving]
    return hyperparams


def _arguments(run: Run, folder: Path, device: str) -> argparse.Namespace:
    """Say as rl_zoo3.train's command line would what the run is, for rl_zoo3's other scripts and for a resumption."""
    conf_file = None
    if not run.tuned:
        conf_file = folder / "hyperparams.yml"
        write_atomically(conf_file, yaml.safe_dump({"default": _hyperparams(run)}).encode())
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
        gym_packages=[],
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
    """Evaluate the final model, which an offline variant has only now."""
    env = evaluation.eval_env
    assert model.env is not None
    sync_envs_normalization(model.env, env)
    env.seed(EVALUATION_SEED)
    returns, _ = evaluate_policy(model, env, FINAL_EPISODES, deterministic=evaluation.deterministic)
    env.close()
    return float(np.mean(returns))


class _Reporter(BaseCallback):
    """Tells of evaluations and steps."""

    def __init__(self, evaluation: EvalCallback, report: Report, watch: Callable[[int], None]):
        super().__init__()
        self._evaluation = evaluation
        self._report = report
        self._watch = watch
        self._n_reported = 0

    def _on_step(self) -> bool:
        self._watch(self.num_timesteps)
        self._tell()
        return True

    def _on_training_end(self) -> None:
        # A run that is taken up from its last step takes no other
        self._tell()

    def _tell(self) -> None:
        timesteps, results = self._evaluation.evaluations_timesteps, self._evaluation.evaluations_results
        for step, returns in _new_points(timesteps, results, self._n_reported):
            self._report(step, float(np.mean(returns)))
        self._n_reported = len(timesteps)

    def get_training_state(self) -> dict[str, Any]:
        """
        Keep nothing: a run that is taken up again reports all of its evaluations anew.

        :return: nothing
        """
        return {}

    def set_training_state(self, state: dict[str, Any]) -> None:
        """
        Restore nothing.

        :param state: nothing
        """


def _new_points(
    timesteps: Sequence[int], results: Sequence[Sequence[float]], n_reported: int
) -> list[tuple[int, Sequence[float]]]:
    """List the evaluations that have not been reported; offline policy training repeats the last step's, and is left out."""
    return [
        (timesteps[index], results[index])
        for index in range(n_reported, len(timesteps))
        if index == 0 or timesteps[index] > timesteps[index - 1]
    ]
