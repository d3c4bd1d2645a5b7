"""A run of ``rl_zoo3.train --algo cgp`` that was interrupted: its settings, its states and its continuation."""

import argparse
import importlib
from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch as th
import yaml
from huggingface_sb3 import EnvironmentName
from rl_zoo3 import ALGOS, exp_manager
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.utils import get_callback_list
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnv

from sb3_cgp.resumption.algorithm import ResumableAlgorithm, resumable
from sb3_cgp.resumption.callbacks import TrainingCheckpointCallback
from sb3_cgp.resumption.environments import restore_environment
from sb3_cgp.resumption.logs import cut_monitors, read_start
from sb3_cgp.resumption.store import StateStore
from sb3_cgp.zoo.folders import ALGO, state_folder
from sb3_cgp.zoo.registration import register


class ResumedExperiment(ExperimentManager):
    """
    rl_zoo3's manager of an interrupted run, which continues in the run's folder from the last state.

    :param folder: the run's folder
    :param args: the run's command line, as rl_zoo3 saved it
    :param hyperparams: the run's hyperparameters, as rl_zoo3 saved them
    """

    def __init__(self, folder: Path, args: argparse.Namespace, hyperparams: dict[str, Any]):
        super().__init__(
            args,
            args.algo,
            args.env,
            args.log_folder,
            args.tensorboard_log,
            args.n_timesteps,
            args.eval_freq,
            args.eval_episodes,
            args.save_freq,
            env_kwargs=args.env_kwargs,
            eval_env_kwargs=args.eval_env_kwargs,
            trained_agent=args.trained_agent,
            seed=args.seed,
            log_interval=args.log_interval,
            save_replay_buffer=args.save_replay_buffer,
            verbose=args.verbose,
            vec_env_type=args.vec_env,
            n_eval_envs=args.n_eval_envs,
            device=args.device,
            show_progress=args.progress,
        )
        self.saved_hyperparams = hyperparams
        # rl_zoo3's constructor has chosen a new folder
        self.save_path = str(folder)
        self.params_path = f"{folder}/{self.env_name}"
        # Makes `setup_experiment` call `_load_pretrained_agent` for the model
        self.continue_training = True

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """
        Return the hyperparameters of the run, because their YAML file may have changed since.

        :return: the hyperparameters, and again in an ordered dictionary
        """
        return dict(self.saved_hyperparams), OrderedDict(self.saved_hyperparams)

    def create_envs(self, n_envs: int, eval_env: bool = False, no_log: bool = False) -> VecEnv:
        """
        Create the environments, whose monitors append to the run's files.

        :param n_envs: number of environments
        :param eval_env: whether the environments are for evaluation
        :param no_log: whether the monitors write no files
        :return: the environments
        """
        # rl_zoo3 replaces the monitors' arguments for some tasks, hence they are changed at its call of `make_vec_env`
        make_vec_env = exp_manager.make_vec_env

        def make_appending(*args: Any, **kwargs: Any) -> VecEnv:
            kwargs["monitor_kwargs"] = {**kwargs["monitor_kwargs"], "override_existing": False}
            return make_vec_env(*args, **kwargs)

        exp_manager.make_vec_env = make_appending
        try:
            return super().create_envs(n_envs, eval_env, no_log)
        finally:
            exp_manager.make_vec_env = make_vec_env

    def _load_pretrained_agent(self, hyperparams: dict[str, Any], env: VecEnv) -> ResumableAlgorithm:
        algorithm = resumable(ALGOS[self.algo])  # type: ignore[arg-type]
        model = algorithm.resume(states_of(Path(self.save_path), self.saved_hyperparams), env, device=self.device)
        assert model.resumption is not None
        if model.verbose < 1:
            print(f"Resuming {self.save_path} at step {model.num_timesteps}")
        paths = [Path(self.save_path) / f"{index}.{Monitor.EXT}" for index in range(env.num_envs)]
        continue_monitors(paths, env, model.num_timesteps, model.resumption["environment"])
        return model

    def _save_config(self, saved_hyperparams: dict[str, Any]) -> None:
        # The files with the run's original settings stay unchanged
        print(f"Log path: {self.save_path}")


def continue_monitors(paths: Sequence[Path | None], env: VecEnv, timestep: int, state: Any) -> None:
    """
    Remove the episodes that ended after the state was saved, because the training repeats them.

    :param paths: the file of each environment's monitor; None for a monitor without a file
    :param env: the environments
    :param timestep: the steps of all environments together when the state was saved
    :param state: the environments' state; None if it was not saved
    """
    n_episodes: list[int | None] = [None] * env.num_envs
    if state is not None:
        # For the number of episodes; `learn` restores the environment again, before its first step
        restore_environment(env, state)
        n_episodes = [len(lengths) for lengths in env.get_attr("episode_lengths")]
    for index, path in enumerate(paths):
        if path is None:
            continue
        cut_monitors(path, n_episodes[index], timestep // env.num_envs)
        # The times in the file are relative to the one in its header
        env.env_method("set_wrapper_attr", "t_start", read_start(path), indices=index)


def read_run(folder: Path) -> tuple[argparse.Namespace, dict[str, Any]]:
    """
    Read the settings that rl_zoo3 saved when a run started.

    :param folder: the run's folder
    :return: the command line, and the hyperparameters
    :raises FileNotFoundError: if the folder is not that of a run
    :raises ValueError: if the run is one of another algorithm
    """
    found = sorted(folder.glob("*/args.yml"))
    if not found:
        raise FileNotFoundError(
            f"{folder} is no folder of a run of rl_zoo3, such as logs/cgp/Pendulum-v1_1: no args.yml in it"
        )
    # rl_zoo3 writes OrderedDicts and tuples, which only the unsafe loader reads; rl_zoo3 uses it, too
    args, hyperparams = (
        dict(yaml.load((found[0].parent / name).read_text(), Loader=yaml.UnsafeLoader)) for name in ("args.yml", "config.yml")
    )
    if args["algo"] != ALGO:
        raise ValueError(f"{folder} is a run of `{args['algo']}`, but only those of `{ALGO}` can be resumed")
    return argparse.Namespace(**args), hyperparams


def states_of(folder: Path, hyperparams: dict[str, Any]) -> str:
    """
    Return the folder of a run's training states.

    :param folder: the run's folder
    :param hyperparams: the run's hyperparameters
    :return: the folder in the arguments of the run's first checkpoint callback, or the default folder
    """
    callbacks = get_callback_list(hyperparams)
    given = [each.path for each in callbacks if isinstance(each, TrainingCheckpointCallback) and each.path is not None]
    return str(given[0]) if given else state_folder(str(folder))


def is_finished(folder: Path, args: argparse.Namespace, hyperparams: dict[str, Any]) -> bool:
    """
    Return whether a run has ended.

    :param folder: the run's folder
    :param args: the run's command line
    :param hyperparams: the run's hyperparameters
    :return: whether the final model exists and its training had ended, by itself or by a callback. rl_zoo3 also saves a model
        after Ctrl-C.
    :raises FileNotFoundError: if the training has not ended, and has no state
    """
    states = states_of(folder, hyperparams)
    steps = StateStore(states).steps()
    env_name = EnvironmentName(args.env)
    model = folder / f"{env_name}.zip"
    n_timesteps = args.n_timesteps if args.n_timesteps > 0 else int(hyperparams["n_timesteps"])
    anew = f"Start it anew, by the command in {folder / env_name / 'command.txt'}"
    if not model.is_file():
        if not steps:
            reason = "the run ended before it saved one, or has no TrainingCheckpointCallback"
            raise FileNotFoundError(f"There is no state in {states}: {reason}. {anew}")
        return False
    data, _, _ = load_from_zip_file(model, device="cpu")
    assert data is not None
    n_done = data["num_timesteps"]
    has_ended = bool(data["_training_has_ended"])
    if not steps and not has_ended:
        raise FileNotFoundError(
            f"The run was interrupted at step {n_done:,} of {n_timesteps:,}, before it saved a state in {states}. {anew}"
        )
    return has_ended


def set_up(folder: Path, args: argparse.Namespace, hyperparams: dict[str, Any]) -> tuple[ResumedExperiment, BaseAlgorithm]:
    """
    Set up the continuation of a run.

    :param folder: the run's folder
    :param args: the run's command line
    :param hyperparams: the run's hyperparameters
    :return: rl_zoo3's manager of the run, and the model in its last state
    :raises ValueError: if all of the run's states are damaged
    """
    # As in rl_zoo3.train
    for package in args.gym_packages:
        importlib.import_module(package)
    set_random_seed(args.seed)
    if args.num_threads > 0:
        th.set_num_threads(args.num_threads)
    register()
    experiment = ResumedExperiment(folder, args, hyperparams)
    results = experiment.setup_experiment()
    assert results is not None
    return experiment, results[0]
