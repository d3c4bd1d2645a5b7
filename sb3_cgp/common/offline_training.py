"""
The beginning of a training in which no environment moves, and what SB3's callbacks see of it: the local variables of SB3's
loop, and a progress bar.

SB3 passes ``locals()`` of ``learn`` and of ``collect_rollouts`` to callbacks, so that these names are part of its interface.
"""

from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, ProgressBarCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.utils import configure_logger


def start_training(model: OffPolicyAlgorithm, callback: MaybeCallback, max_steps: int, progress_bar: bool) -> BaseCallback:
    """
    Begin a training as SB3's ``learn`` does: with a logger, callbacks, and a progress bar if one is displayed.

    :param model: the model
    :param callback: the callbacks
    :param max_steps: largest number of calls of ``on_step``
    :param progress_bar: whether a progress bar is displayed
    :return: the callbacks, initialised, and told that the training begins
    :raises ImportError: if a progress bar needs a package that is not installed, tqdm or rich
    """
    if not hasattr(model, "_logger"):
        # No `learn` has configured it, as in a loaded model. SB3 would otherwise write to the folder of the newest run.
        model._logger = configure_logger(model.verbose, model.tensorboard_log, "CGP", reset_num_timesteps=True)
    callback = model._init_callback(callback)
    callback = _with_progress_bar(callback) if progress_bar else callback
    callback.on_training_start(_learn_locals(model, callback, max_steps, progress_bar), globals())
    return callback


def _learn_locals(model: OffPolicyAlgorithm, callback: BaseCallback, max_steps: int, progress_bar: bool) -> dict[str, Any]:
    """Return the local variables of ``learn``, by name, for a training of ``max_steps`` steps."""
    return {
        "self": model,
        "total_timesteps": model.num_timesteps + max_steps * model.n_envs,
        "callback": callback,
        "log_interval": None,
        "tb_log_name": type(model).__name__,
        "reset_num_timesteps": False,
        "progress_bar": progress_bar,
    }


def rollout_locals(model: OffPolicyAlgorithm, callback: BaseCallback) -> dict[str, Any]:
    """
    Return the local variables of ``collect_rollouts`` for a step in which no environment moves.

    Rewards are 0, no episode ends, and actions are in the middle of their range.

    :param model: the model
    :param callback: the callbacks
    :return: the local variables by name
    """
    scaled_actions = np.zeros((model.n_envs, *(model.action_space.shape or ())), dtype=np.float32)
    return {
        "self": model,
        "env": model.env,
        "callback": callback,
        "train_freq": model.train_freq,
        "replay_buffer": model.replay_buffer,
        "action_noise": model.action_noise,
        "learning_starts": model.learning_starts,
        "log_interval": None,
        "num_collected_steps": 0,
        "num_collected_episodes": 0,
        "continue_training": True,
        "actions": model.policy.unscale_action(scaled_actions),
        "buffer_actions": scaled_actions,
        # SB3 keeps the last observations nowhere else
        "new_obs": model._last_obs,
        "rewards": np.zeros(model.n_envs, dtype=np.float32),
        "dones": np.zeros(model.n_envs, dtype=bool),
        "infos": [{} for _ in range(model.n_envs)],
    }


class _ProgressBar(ProgressBarCallback):
    """SB3's progress bar, for a model that may have no environment."""

    def _on_step(self) -> bool:
        self.pbar.update(self.model.n_envs)
        return True


def _with_progress_bar(callback: BaseCallback) -> BaseCallback:
    """Add a progress bar to initialised callbacks."""
    progress_bar = _ProgressBar()
    progress_bar.init_callback(callback.model)
    callbacks = CallbackList([callback, progress_bar])
    callbacks.model = callback.model
    return callbacks
