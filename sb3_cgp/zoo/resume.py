"""
Continues a training of ``rl_zoo3.train --algo cgp`` that was interrupted, in its own folder.

``python -m sb3_cgp.zoo.resume logs/cgp/Pendulum-v1_1`` needs nothing else: what the run was started with is in its folder.
"""

import argparse
import importlib
import os
import sys
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
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnv

from sb3_cgp.resumption.algorithm import ResumableAlgorithm, resumable
from sb3_cgp.resumption.callbacks import TrainingCheckpointCallback
from sb3_cgp.resumption.environments import restore_environment
from sb3_cgp.resumption.logs import cut_monitors, read_start
from sb3_cgp.resumption.store import StateStore
from sb3_cgp.zoo.registration import ALGO, register, state_folder


class ResumedExperiment(ExperimentManager):
    """
    rl_zoo3's manager of a run that is there already: it goes on in the run's folder, from the state saved last.

    :param folder: the run's folder
    :param args: the run's command line, as rl_zoo3 has saved it
    :param hyperparams: the run's hyperparameters, as rl_zoo3 has saved them
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
        # rl_zoo3's constructor chose a new folder
        self.save_path = str(folder)
        self.params_path = f"{folder}/{self.env_name}"
        # Has `setup_experiment` ask `_load_pretrained_agent` for the model
        self.continue_training = True

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """
        Take the hyperparameters from the run, as the file that they came from may have changed since.

        :return: the hyperparameters, twice
        """
        # As in rl_zoo3
        if "env_kwargs" in self.saved_hyperparams and self.env_kwargs and self._eval_env_kwargs_args is None:
            self.eval_env_kwargs = self.saved_hyperparams["env_kwargs"]
        return dict(self.saved_hyperparams), OrderedDict(self.saved_hyperparams)

    def create_envs(self, n_envs: int, eval_env: bool = False, no_log: bool = False) -> VecEnv:
        """
        Create the environments, whose monitors go on in the files that are there.

        :param n_envs: number of environments
        :param eval_env: whether they are for evaluation
        :param no_log: whether they have no monitors' files
        :return: the environments
        """
        # rl_zoo3 replaces the monitors' arguments for some tasks, so that they are changed where it hands them on
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
        print(f"Resuming {self.save_path} at step {model.num_timesteps}")
        self._continue_monitors(env, model.num_timesteps, model.resumption["environment"])
        return model

    def _continue_monitors(self, env: VecEnv, timestep: int, state: Any) -> None:
        """Cut off the episodes that ended after the state was saved: they are about to come again."""
        paths = [Path(self.save_path) / f"{index}.{Monitor.EXT}" for index in range(env.num_envs)]
        n_episodes: list[int | None] = [None] * env.num_envs
        if state is not None:
            # `learn` does it again, before its first step
            restore_environment(env, state)
            n_episodes = [len(lengths) for lengths in env.get_attr("episode_lengths")]
        for index, path in enumerate(paths):
            cut_monitors(path, n_episodes[index], timestep // env.num_envs)
            # Times in the file count from its header
            env.env_method("set_wrapper_attr", "t_start", read_start(path), indices=index)

    def _save_config(self, saved_hyperparams: dict[str, Any]) -> None:
        # What the run was started with stays as it is
        print(f"Log path: {self.save_path}")


def read_run(folder: Path) -> tuple[argparse.Namespace, dict[str, Any]]:
    """
    Read what rl_zoo3 saved of a run when it started.

    :param folder: the run's folder
    :return: the command line, and the hyperparameters
    :raises FileNotFoundError: if it is not a run's folder
    :raises ValueError: if the run is another algorithm's
    """
    found = sorted(folder.glob("*/args.yml"))
    if not found:
        raise FileNotFoundError(
            f"{folder} is no folder of a run of rl_zoo3, such as logs/cgp/Pendulum-v1_1: no args.yml in it"
        )
    # rl_zoo3 writes OrderedDicts and tuples, which only the unsafe loader reads, as rl_zoo3 does itself
    args, hyperparams = (
        dict(yaml.load((found[0].parent / name).read_text(), Loader=yaml.UnsafeLoader)) for name in ("args.yml", "config.yml")
    )
    if args["algo"] != ALGO:
        raise ValueError(f"{folder} is a run of `{args['algo']}`, but only those of `{ALGO}` can be resumed")
    return argparse.Namespace(**args), hyperparams


def states_of(folder: Path, hyperparams: dict[str, Any]) -> str:
    """
    Tell where a run's training states are.

    :param folder: the run's folder
    :param hyperparams: the run's hyperparameters
    :return: the folder that its first checkpoint callback was given, or the one that it takes by itself
    """
    callbacks = get_callback_list(hyperparams)
    given = [each.path for each in callbacks if isinstance(each, TrainingCheckpointCallback) and each.path is not None]
    return str(given[0]) if given else state_folder(str(folder))


def is_finished(folder: Path, args: argparse.Namespace, hyperparams: dict[str, Any]) -> bool:
    """
    Tell whether there is anything left to train.

    :param folder: the run's folder
    :param args: the run's command line
    :param hyperparams: the run's hyperparameters
    :return: whether the final model is there, of a training that was not interrupted from the keyboard, be it within the
        offline training of its policy
    :raises FileNotFoundError: if there is something left, and no state to go on from
    """
    states = states_of(folder, hyperparams)
    steps = StateStore(states).steps()
    env_name = EnvironmentName(args.env)
    model = folder / f"{env_name}.zip"
    n_timesteps = args.n_timesteps if args.n_timesteps > 0 else int(hyperparams["n_timesteps"])
    if not steps and not model.is_file():
        raise FileNotFoundError(
            f"There is no state in {states}: the run ended before it saved one, or has no TrainingCheckpointCallback. "
            f"Start it anew, by the command in {folder / env_name / 'command.txt'}"
        )
    if not model.is_file() or not steps:
        return model.is_file()
    data, _, _ = load_from_zip_file(model, device="cpu")
    assert data is not None
    return max(steps) >= n_timesteps and not data["_policy_is_due"]


def resume(folder: Path, args: argparse.Namespace, hyperparams: dict[str, Any]) -> None:
    """
    Train a run to its end, and save its final model as rl_zoo3 does.

    :param folder: the run's folder
    :param args: the run's command line
    :param hyperparams: the run's hyperparameters
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
    model, _ = results
    experiment.learn(model)
    experiment.save_trained_model(model)


def main(argv: Sequence[str] | None = None) -> None:
    """
    Resume the run that the command line names.

    :param argv: the command line; None for the process's own
    """
    parser = argparse.ArgumentParser(prog="python -m sb3_cgp.zoo.resume", description="Resume a training of rl_zoo3 with CGP.")
    parser.add_argument("folder", help="the run's folder, such as logs/cgp/Pendulum-v1_1")
    folder = Path(os.path.normpath(parser.parse_args(argv).folder))
    try:
        args, hyperparams = read_run(folder)
        has_ended = is_finished(folder, args, hyperparams)
    except (FileNotFoundError, ValueError) as error:
        sys.exit(f"Error: {error}")
    if has_ended:
        print(f"{folder} has ended: there is nothing to resume")
    else:
        resume(folder, args, hyperparams)


if __name__ == "__main__":
    main()
