"""Training states of rl_zoo3's runs: their folder, and environments that can be restored."""

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_cgp.resumption.callbacks import TrainingCheckpointCallback
from sb3_cgp.resumption.environments import RestorableEnv
from sb3_cgp.zoo.folders import state_folder

if TYPE_CHECKING:
    import gymnasium as gym


def prepare_checkpoints(experiment: Any) -> None:
    """
    Give a run's checkpoint callbacks the folder for their states, and wrap environments in worker processes so that they
    can be restored.

    :param experiment: rl_zoo3's manager of the run, which has made its specified callbacks and not yet its environments
    """
    checkpoints = [each for each in experiment.callbacks if isinstance(each, TrainingCheckpointCallback)]
    for each in checkpoints:
        if each.path is None:
            each.path = state_folder(experiment.save_path)
    if checkpoints and issubclass(experiment.vec_env_class, SubprocVecEnv):
        experiment.env_wrapper = functools.partial(_make_restorable, experiment.env_wrapper)


def without_checkpoints(specified: Any) -> list[Any]:
    """
    Leave checkpoint callbacks out of those that a YAML file specifies, as Optuna's trials neither have a folder of their own
    nor are resumed.

    :param specified: rl_zoo3's value of ``callback``: a name, a dictionary of a name and its arguments, a callback, or a list
    :return: the others
    """
    from rl_zoo3.utils import get_class_by_name

    entries = specified if isinstance(specified, list) else [specified] if specified else []
    names = [next(iter(entry)) if isinstance(entry, dict) else entry for entry in entries]
    kinds = [get_class_by_name(name) if isinstance(name, str) else type(name) for name in names]
    return [entry for entry, kind in zip(entries, kinds, strict=True) if not issubclass(kind, TrainingCheckpointCallback)]


def _make_restorable(env_wrapper: "Callable[[gym.Env], gym.Env] | None", env: "gym.Env") -> RestorableEnv:
    """
    Wrap an environment as rl_zoo3 would, and make it restorable.

    :param env_wrapper: rl_zoo3's wrapper, None for none
    :param env: the environment
    :return: the wrapped environment
    """
    return RestorableEnv(env if env_wrapper is None else env_wrapper(env))
