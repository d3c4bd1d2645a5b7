"""
The complete state of a training: SB3's zip, and all state that the zip does not hold. A restored training is exact: it
computes the same numbers as a training that was not interrupted.

A state is a tree of plain data, arrays and tensors (:mod:`sb3_cgp.resumption.encoding`), and of the bytes of the zip, which
``resume`` unpickles.
"""

import io
import random
import warnings
from contextlib import suppress
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.utils import set_random_seed

from sb3_cgp.common.replay_buffers import end_last_episode
from sb3_cgp.common.rules import require
from sb3_cgp.resumption.callback_states import callback_states, restore_callbacks
from sb3_cgp.resumption.environments import restore_environment, state_and_obstacles
from sb3_cgp.resumption.logs import tensorboard_folder
from sb3_cgp.resumption.model import ResumableModel, State
from sb3_cgp.resumption.parameters import check_optimizers, frozen_parameters
from sb3_cgp.resumption.plain_data import NUMERIC, plain_attributes, set_plain_attributes
from sb3_cgp.resumption.replay_buffers import replay_buffer_state

# VecNormalize's statistics, which outlive an episode
STATISTICS = ("obs_rms", "ret_rms")


def gather(model: ResumableModel, callback: BaseCallback) -> State:
    """
    Gather the complete state of a training, between the gradient steps of one rollout and the first step of the next. Warn
    once per training of each part that cannot be saved.

    :param model: the model
    :param callback: the training's callbacks
    :return: the state; it may share arrays with the training, which will change them
    :raises ValueError: if an optimizer was set on the model that a resumed training would not have
    """
    assert model.env is not None
    check_optimizers(model)
    model._before_saving_state()
    zipped = io.BytesIO()
    model.save(zipped)
    normalizer = model.get_vec_normalize_env()
    environment, obstacles = state_and_obstacles(model.env)
    callbacks, problems = callback_states(callback, model.env, model._training.initial_callbacks)
    if obstacles:
        consequence = "A resumed training will continue at the start of a new episode, unlike an uninterrupted one."
        problems.insert(0, f"The environment's state cannot be saved. {' '.join(obstacles)} {consequence}")
    for message in problems:
        if message not in model._training.warned_of:
            warnings.warn(message, stacklevel=2)
    model._note_training(warned_of=model._training.warned_of | set(problems))
    return {
        "algorithm": type(model).__name__,
        "n_envs": model.n_envs,
        "model": zipped.getvalue(),
        "frozen": frozen_parameters(model.policy),
        "replay_buffer": replay_buffer_state(model._ensure_replay_buffer()),
        "environment": environment,
        "not_restorable": " ".join(obstacles) or None,
        "statistics": None if normalizer is None else plain_attributes(normalizer, set(vars(normalizer)) - set(STATISTICS)),
        "callbacks": callbacks,
        "logger": _pending(model.logger),
        "log_folder": tensorboard_folder(model.logger),
        "tensorboard_log": None if model.tensorboard_log is None else str(model.tensorboard_log),
        "random": _random_state(model),
    }


def restore(model: ResumableModel, callback: BaseCallback, state: State) -> None:
    """
    Restore the part of the state that neither ``ResumableAlgorithm.resume`` nor SB3 has restored.

    :param model: the model of the resumed training
    :param callback: the callbacks of the resumed training
    :param state: the state
    :raises ValueError: if the environment is not the saved one
    """
    assert model.env is not None
    if state["environment"] is not None:
        restore_environment(model.env, state["environment"])
        vars(model).update(state["last"])
    restore_callbacks(callback, state["callbacks"])
    for name, values in state["logger"].items():
        pending = getattr(model.logger, name)
        pending.clear()
        pending.update(values)
    # Last, as the calls above may draw random numbers
    _restore_random(model, state["random"])


def begin_new_episode(model: ResumableModel, state: State) -> None:
    """
    Prepare a training whose environment cannot be restored to continue at the start of a new episode, with random numbers that
    follow from the seed and the step.

    :param model: the model, whose environment is about to be reset
    :param state: the state
    """
    warnings.warn(
        f"The environment's state was not saved: {state['not_restorable']} The training continues at the start of a "
        "new episode, and its results will differ from those of an uninterrupted training.",
        stacklevel=2,
    )
    # By the seed itself, as `load` sets it, each resumption would repeat the training's first episodes
    seed = int(np.random.SeedSequence((model.seed or 0, model.num_timesteps)).generate_state(1)[0])
    # For environments that draw from the global generators
    set_random_seed(seed)
    assert model.env is not None
    # Vectorised environments of other packages may have no such method
    with suppress(AttributeError):
        model.env.seed(seed)
    model._last_obs = None
    end_last_episode(model._ensure_replay_buffer())
    normalizer = model.get_vec_normalize_env()
    if normalizer is not None and state["statistics"] is not None:
        set_plain_attributes(normalizer, state["statistics"])


def check_fits(model: ResumableModel, state: State) -> None:
    """
    Refuse a state of another number of environments than the model's, or of another normalisation.

    :param model: the loaded model
    :param state: the state
    :raises ValueError: if the number of environments differs, or only one of both has ``VecNormalize``
    """
    assert model.env is not None
    n_envs, saved = state["n_envs"], f"{state['n_envs']}, as was saved"
    require(model.env.num_envs == n_envs, "env.num_envs", model.env.num_envs, saved)
    require(model.n_envs == n_envs, "n_envs", model.n_envs, saved)
    noises = getattr(model.action_noise, "noises", None)
    require(noises is None or len(noises) == n_envs, "action_noise.n_envs", len(noises or ()), saved)
    is_normalized, was_normalized = model.get_vec_normalize_env() is not None, state["statistics"] is not None
    allowed = f"{'' if was_normalized else 'not '}wrapped in VecNormalize, as it was when the state was saved"
    require(is_normalized == was_normalized, "env", model.env, allowed)


def _pending(logger: Logger) -> State:
    """Copy the recorded numbers and strings that have not been written. Images, figures and videos are omitted."""
    plain = {key: _plain_logged(value) for key, value in logger.name_to_value.items()}
    kept = [key for key, value in plain.items() if value is not None]
    recorded = {"name_to_value": plain, "name_to_count": logger.name_to_count, "name_to_excluded": logger.name_to_excluded}
    # Keys may be of an enumeration, too, whose member is equal to its string, and not to what `str` returns
    return {name: {str.__str__(key): values[key] for key in kept if key in values} for name, values in recorded.items()}


def _plain_logged(value: Any) -> Any:
    """Return a number or string by a type of Python's or NumPy's own, which an enumeration's is not; None for other values."""
    if isinstance(value, np.generic) and value.dtype.kind in NUMERIC:
        return value
    return next((kind(value) for kind in (bool, int, float, str) if isinstance(value, kind)), None)


def _random_state(model: ResumableModel) -> dict[str, Any]:
    return {
        "python": random.getstate(),
        "numpy": np.random.get_state(),  # noqa: NPY002  # SB3's generator
        "torch": th.get_rng_state(),
        "cuda": th.cuda.get_rng_state_all() if th.cuda.is_available() else [],
        "action_space": model.action_space.np_random.bit_generator.state,
    }


def _restore_random(model: ResumableModel, state: dict[str, Any]) -> None:
    random.setstate(state["python"])
    np.random.set_state(state["numpy"])  # noqa: NPY002
    th.set_rng_state(state["torch"])
    # Another machine may have fewer GPUs, or none
    n_devices = th.cuda.device_count() if th.cuda.is_available() else 0
    for index, cuda_state in enumerate(state["cuda"][:n_devices]):
        th.cuda.set_rng_state(cuda_state, index)
    model.action_space.np_random.bit_generator.state = state["action_space"]
