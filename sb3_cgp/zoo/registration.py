"""CGP in rl_zoo3: the algorithm, its default hyperparameters, checkpoints, and Optuna's search space with its converter.

An installed sb3_cgp does all this by itself as soon as rl_zoo3 is imported (``_sb3_cgp_zoo.py``); :func:`register` is for
whoever runs without that, from a source tree or with ``python -S``, say. rl_zoo3 is imported inside the functions:
the hook calls them while rl_zoo3 is still being imported.
"""

import functools
import importlib
import inspect
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from stable_baselines3.common.noise import ActionNoise, NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_cgp.core.cgp import CGP
from sb3_cgp.resumption.callbacks import TrainingCheckpointCallback
from sb3_cgp.resumption.environments import RestorableEnv

if TYPE_CHECKING:
    import gymnasium as gym
    import optuna

ALGO = "cgp"

# One choice of Optuna's for each pair, so that no sample pairs "no policy loss" with offline training.
VARIANTS: dict[str, dict[str, str | None]] = {
    "cgp-online": {"policy_loss": "cgp", "policy_training": "online"},
    "cgp-offline": {"policy_loss": "cgp", "policy_training": "offline"},
    "qgp-online": {"policy_loss": "qgp", "policy_training": "online"},
    "qgp-offline": {"policy_loss": "qgp", "policy_training": "offline"},
    # Says how to act too: a YAML entry's actor would not exist.
    "cem": {"policy_loss": None, "policy_training": "online", "inference": "cem"},
}


def register() -> None:
    """Make CGP known to rl_zoo3: ``--algo cgp``, its default hyperparameters and its search space. Harmless if repeated."""
    register_algorithm()
    register_search_space()
    register_default_config()


def register_algorithm() -> None:
    """Add CGP to rl_zoo3's algorithms, from which its scripts make the choices for ``--algo``."""
    from rl_zoo3.utils import ALGOS

    ALGOS[ALGO] = CGP
    mend_push_to_hub()


def mend_push_to_hub() -> None:
    """
    Restore the function that ``rl_zoo3.push_to_hub`` imports and cannot start without, if it is missing.

    sb3-team-hf-integration 3.2, the only release that rl_zoo3 2.9.2 accepts, has made it private, and has it return an
    object where rl_zoo3 needs a dictionary.
    """
    # huggingface_sb3 hides this module behind a function of the same name.
    hub: Any = importlib.import_module("huggingface_sb3.push_to_hub")
    if hasattr(hub, "generate_metadata") or not hasattr(hub, "_generate_metadata"):
        return

    def generate_metadata(model_name: str, env_id: str, mean_reward: float, std_reward: float) -> dict[str, Any]:
        return hub._generate_metadata(model_name, env_id, mean_reward, std_reward).to_dict()

    hub.generate_metadata = generate_metadata


def register_search_space() -> None:
    """Add what ``rl_zoo3.train -optimize`` and ``--trial-id`` need."""
    from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER

    HYPERPARAMS_SAMPLER[ALGO] = sample_cgp_params
    HYPERPARAMS_CONVERTER[ALGO] = convert_cgp_params


def register_default_config() -> None:
    """
    Have rl_zoo3 read our ``cgp.yml`` where no ``--conf-file`` is given, as it looks inside its own package only, and save
    training states in the run's folder.
    """
    from rl_zoo3.exp_manager import ExperimentManager

    initialise = ExperimentManager.__init__
    if hasattr(initialise, "reads_cgp_yml"):
        return
    signature = inspect.signature(initialise)

    @functools.wraps(initialise)
    def __init__(self: Any, *args: Any, **kwargs: Any) -> None:
        initialise(self, *args, **kwargs)
        given = signature.bind(self, *args, **kwargs).arguments
        if self.algo == ALGO and not given.get("config"):
            self.config = str(hyperparams_folder() / f"{ALGO}.yml")

    __init__.reads_cgp_yml = True  # type: ignore[attr-defined]
    ExperimentManager.__init__ = __init__  # type: ignore[method-assign]

    create_callbacks = ExperimentManager.create_callbacks

    @functools.wraps(create_callbacks)
    def create_callbacks_with_folder(self: Any) -> None:
        # Optuna's trials make callbacks of their own, which save nothing
        if not self.optimize_hyperparameters:
            prepare_checkpoints(self)
        create_callbacks(self)
        # rl_zoo3 ends the first of them itself after an error, to take a progress bar away
        self.callbacks.sort(key=lambda callback: isinstance(callback, TrainingCheckpointCallback))

    ExperimentManager.create_callbacks = create_callbacks_with_folder  # type: ignore[method-assign]


def state_folder(save_path: str) -> str:
    """
    Tell where a run's training states lie.

    :param save_path: the run's folder
    :return: the folder of the states
    """
    return os.path.join(save_path, "state")


def prepare_checkpoints(experiment: Any) -> None:
    """
    Let a run's checkpoint callbacks save into the run's folder, and its environments be restored.

    :param experiment: rl_zoo3's manager of the run, its specified callbacks made and its environments not yet
    """
    checkpoints = [each for each in experiment.callbacks if isinstance(each, TrainingCheckpointCallback)]
    for each in checkpoints:
        if each.path is None:
            each.path = state_folder(experiment.save_path)
    if checkpoints and issubclass(experiment.vec_env_class, SubprocVecEnv):
        experiment.env_wrapper = functools.partial(_make_restorable, experiment.env_wrapper)


def _make_restorable(env_wrapper: "Callable[[gym.Env], gym.Env] | None", env: "gym.Env") -> RestorableEnv:
    return RestorableEnv(env if env_wrapper is None else env_wrapper(env))


def hyperparams_folder() -> Path:
    """
    Find the folder with the hyperparameters of the zoo's format.

    :return: inside the package when installed from a wheel, beside it in a source tree or an editable install
    """
    package = Path(__file__).resolve().parent.parent
    for folder in (package / "hyperparams", package.parent / "hyperparams"):
        if (folder / f"{ALGO}.yml").is_file():
            return folder
    raise FileNotFoundError(f"hyperparams/{ALGO}.yml is neither in {package} nor beside it: please install sb3_cgp again")


def sample_cgp_params(trial: "optuna.Trial", n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
    """
    Sample hyperparameters for CGP, all of them in every trial: a search space without conditions is one that Optuna's
    multivariate TPE can model as a whole. Every sample is valid.

    rl_zoo3 scores a trial by its last evaluation. An offline variant trains its policy after the last environment step, and
    that score is CEM's if the policy converges before the next evaluation is due.

    :param trial: Optuna's trial
    :param n_actions: number of action dimensions, for the action noise
    :param n_envs: number of environments; unused
    :param additional_args: whether and with which arguments a ``HerReplayBuffer`` is used
    :return: arguments for CGP
    """
    from rl_zoo3.hyperparams_opt import sample_her_params

    one_minus_gamma = trial.suggest_float("one_minus_gamma", 0.0001, 0.03, log=True)
    # From 2**5=32 to 2**9=512: a gradient step's time grows with batch size times samples
    trial.suggest_int("batch_size_pow", 5, 9)
    trial.suggest_float("learning_rate", 1e-5, 0.002, log=True)
    trial.suggest_float("actor_learning_rate", 1e-5, 0.002, log=True)
    trial.suggest_int("train_freq", 1, 10)
    trial.suggest_int("subsample_steps", 1, 4)
    trial.suggest_float("tau", 0.001, 0.08, log=True)
    trial.suggest_int("policy_delay", 1, 4)
    trial.suggest_int("target_update_interval", 1, 4)
    trial.suggest_float("target_policy_noise", 0.0, 0.5)
    trial.suggest_float("target_noise_clip", 0.1, 1.0)
    trial.suggest_categorical("noise_type", ["none", "normal", "ornstein-uhlenbeck"])
    trial.suggest_float("noise_std", 0.0, 0.5)
    trial.suggest_categorical("net_arch", ["small", "medium", "big"])

    trial.suggest_int("cem_iterations", 1, 5)
    # From 2**4=16 to 2**7=128
    trial.suggest_int("cem_samples_pow", 4, 7)
    trial.suggest_float("cem_elite_fraction", 0.02, 0.5, log=True)
    trial.suggest_categorical("cem_result", ["best", "mean"])
    trial.suggest_categorical("variant", list(VARIANTS))

    if additional_args["using_her_replay_buffer"]:
        her_kwargs = sample_her_params(trial, {}, additional_args["her_kwargs"])
    else:
        her_kwargs = {}

    # From the trial's parameters alone, as `--trial-id` does later: the two cannot differ.
    hyperparams = convert_cgp_params(trial.params)
    hyperparams["action_noise"] = _action_noise(hyperparams.pop("noise_type"), hyperparams.pop("noise_std"), n_actions)
    # Display true values
    trial.set_user_attr("gamma", 1 - one_minus_gamma)
    for name in ("batch_size", "gradient_steps", "cem_samples", "cem_elites"):
        trial.set_user_attr(name, hyperparams[name])
    # With what the user set beside the two that are sampled
    return hyperparams | her_kwargs


def convert_cgp_params(sampled_params: dict[str, Any]) -> dict[str, Any]:
    """
    Convert a trial's parameters to hyperparameters as a YAML file has them, with ``noise_type`` and ``noise_std``.

    :param sampled_params: what :func:`sample_cgp_params` suggested
    :return: hyperparameters
    """
    from rl_zoo3.hyperparams_opt import convert_offpolicy_params

    hyperparams = convert_offpolicy_params(sampled_params)
    hyperparams.update(VARIANTS[hyperparams.pop("variant")])
    hyperparams["cem_samples"] = 2 ** hyperparams.pop("cem_samples_pow")
    # At least one, and never more than there are samples
    hyperparams["cem_elites"] = max(round(hyperparams.pop("cem_elite_fraction") * hyperparams["cem_samples"]), 1)
    if hyperparams["noise_type"] == "none":
        # Said with a standard deviation of 0, as rl_zoo3 has no word that takes back the noise of a YAML entry.
        hyperparams.update(noise_type="normal", noise_std=0.0)
    her_kwargs = {name: hyperparams.pop(name) for name in ("n_sampled_goal", "goal_selection_strategy") if name in hyperparams}
    if her_kwargs:
        hyperparams["replay_buffer_kwargs"] = her_kwargs
    return hyperparams


def _action_noise(noise_type: str, noise_std: float, n_actions: int) -> ActionNoise:
    """
    :param noise_type: "normal" or "ornstein-uhlenbeck"
    :param noise_std: standard deviation
    :param n_actions: number of action dimensions
    :return: the noise, as rl_zoo3 makes it from a YAML file's entries
    """
    noise_class = {"normal": NormalActionNoise, "ornstein-uhlenbeck": OrnsteinUhlenbeckActionNoise}[noise_type]
    return noise_class(mean=np.zeros(n_actions), sigma=noise_std * np.ones(n_actions))
