"""Training runs of rl_zoo3, found in its folders."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from huggingface_sb3 import EnvironmentName
from rl_zoo3 import get_latest_run_id
from rl_zoo3.utils import get_model_path

from benchmark.common.environments import split_env_id


@dataclass(frozen=True)
class Run:
    """
    A finished training run of rl_zoo3.

    :param algo: the algorithm's name in rl_zoo3
    :param env_name: the environment
    :param folder: the run's folder
    :param model_path: the final model
    """

    algo: str
    env_name: EnvironmentName
    folder: Path
    model_path: Path

    @property
    def settings_folder(self) -> Path:
        """The folder of the hyperparameters, the command line and the normalisation statistics."""
        return self.folder / self.env_name

    def read_yaml(self, name: str) -> dict[str, Any]:
        """
        Read a file that rl_zoo3 saved about the run.

        :param name: ``config.yml`` (the hyperparameters) or ``args.yml`` (the command line)
        :return: the file's content; empty without such a file
        :raises ValueError: if the file is damaged; it names the file and the remedy
        """
        path = self.settings_folder / name
        return read_settings(path) if path.is_file() else {}


def read_settings(path: Path, *keys: str) -> dict[str, Any]:
    """
    Read a YAML file that rl_zoo3 saved about a run.

    :param path: the file
    :param keys: keys that it must have
    :return: the file's content
    :raises ValueError: if the file is damaged; it names the file and the remedy
    """
    remedy = "restore it from a copy, or name another run"
    try:
        # rl_zoo3 writes OrderedDicts and tuples, which only the unsafe loader reads, as rl_zoo3 does itself
        settings = dict(yaml.load(path.read_text(), Loader=yaml.UnsafeLoader))
    except (yaml.YAMLError, TypeError, ValueError) as error:
        raise ValueError(f"{path} is damaged: {remedy}. It is no mapping in YAML: {error}") from error
    missing = [key for key in keys if key not in settings]
    if missing:
        raise ValueError(f"{path} lacks {', '.join(missing)}: {remedy}")
    return settings


def find_run(folder: str, algo: str, env_id: str, exp_id: int = 0) -> Run:
    """
    Return a run in rl_zoo3's log folder.

    :param folder: rl_zoo3's log folder
    :param algo: the algorithm's name in rl_zoo3
    :param env_id: the environment
    :param exp_id: the run's number; 0 for the latest
    :return: the run
    :raises FileNotFoundError: if there is no such run, it has no final model, or it is on another environment, which has the
        same name in rl_zoo3's folders
    :raises ValueError: if the run's ``args.yml`` is damaged; it names the file and the remedy
    """
    env_name = EnvironmentName(env_id)
    runs = Path(folder) / algo
    exp_id = exp_id or get_latest_run_id(str(runs), env_name)
    if exp_id == 0:
        raise FileNotFoundError(
            f"No run of {algo} on {env_id} in {runs}: train one with `make train ALGO={algo} ENV={env_id}`, "
            "or name another log folder with --folder"
        )
    try:
        _, model_path, run_folder = get_model_path(exp_id, folder, algo, env_name)
    except (AssertionError, ValueError) as error:
        raise FileNotFoundError(
            f"No trained model in {runs / f'{env_name}_{exp_id}'}: wait until its training has ended, "
            "or name another run with --exp-id"
        ) from error
    run = Run(algo, EnvironmentName(split_env_id(env_id)[1]), Path(run_folder), Path(model_path))
    trained = run.read_yaml("args.yml").get("env", run.env_name.gym_id)
    if trained != run.env_name.gym_id:
        raise FileNotFoundError(f"{run_folder} is a run on {trained}, and not on {env_id}: name another run with --exp-id")
    return run


def run_in(folder: Path) -> Run:
    """
    Return the run of a folder.

    :param folder: the run's folder
    :return: the run
    :raises FileNotFoundError: if it is not a run's folder, or has no final model
    :raises ValueError: if the run's ``args.yml`` is damaged; it names the file and the remedy
    """
    settings = next(folder.glob("*/args.yml"), None)
    if settings is None:
        raise FileNotFoundError(f"{folder} is no folder of a run, such as logs/cgp/Pendulum-v1_1: no args.yml in it")
    model_path = folder / f"{settings.parent.name}.zip"
    if not model_path.is_file():
        raise FileNotFoundError(f"No trained model in {folder}: wait until its training has ended")
    args = read_settings(settings, "algo", "env")
    return Run(args["algo"], EnvironmentName(args["env"]), folder, model_path)
