"""
The whole state of a training, from which it goes on to the bit: what SB3 saves, and everything that it leaves out.

A state is a tree of plain data, arrays and tensors (:mod:`.store`). What SB3 saves itself is in it as SB3's own zip.
"""

import inspect
import io
import os
import random
import warnings
from collections import Counter
from collections.abc import Iterator
from enum import Enum
from types import FunctionType
from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_cgp.common.episodes import end_last_episode
from sb3_cgp.common.rules import require
from sb3_cgp.resumption.environments import environment_state, restore_environment, why_not_restorable
from sb3_cgp.resumption.plain_data import plain_attributes, set_plain_attributes

if TYPE_CHECKING:
    from sb3_cgp.resumption.algorithm import ResumableAlgorithm

State = dict[str, Any]
# VecNormalize's statistics, which outlive an episode
STATISTICS = ("obs_rms", "ret_rms")
# Of a replay buffer's attributes; its environment is saved as the model's
STATELESS_TYPES = (Enum, FunctionType, np.dtype, spaces.Space, th.device, type, VecEnv)


def gather(model: "ResumableAlgorithm", callback: BaseCallback) -> State:
    """
    Gather the whole state of a training, between a gradient step and the next step of the environment.

    :param model: the model
    :param callback: the training's callbacks
    :return: the state; arrays may be those that training goes on to change
    """
    assert model.env is not None
    assert model.replay_buffer is not None
    zipped = io.BytesIO()
    model.save(zipped)
    normalizer = model.get_vec_normalize_env()
    return {
        "algorithm": type(model).__name__,
        "n_envs": model.n_envs,
        "model": zipped.getvalue(),
        "replay_buffer": _replay_state(model.replay_buffer),
        "environment": environment_state(model.env),
        "not_restorable": why_not_restorable(model.env),
        "statistics": None if normalizer is None else plain_attributes(normalizer, without=_all_but(normalizer, STATISTICS)),
        "callbacks": [_callback_state(each, model.env) for each in walk(callback)],
        "logger": _pending(model.logger),
        "log_folder": None if model.logger.dir is None else os.path.abspath(model.logger.dir),
        "random": _random_state(model),
    }


def restore(model: "ResumableAlgorithm", callback: BaseCallback, state: State) -> None:
    """
    Restore what ``ResumableAlgorithm.resume`` and SB3 have not: the last of it are the random states.

    :param model: the model, where the training that is to go on was interrupted
    :param callback: the callbacks of the training that goes on
    :param state: the state
    :raises ValueError: if the environment is not the one that was saved
    """
    assert model.env is not None
    if state["environment"] is not None:
        restore_environment(model.env, state["environment"])
        vars(model).update(state["last"])
    _restore_callbacks(callback, state["callbacks"])
    for name, values in state["logger"].items():
        pending = getattr(model.logger, name)
        pending.clear()
        pending.update(values)
    _restore_random(model, state["random"])


def begin_new_episode(model: "ResumableAlgorithm", state: State) -> None:
    """
    Let a training whose environment cannot be restored go on at an episode's start.

    :param model: the model, its environment about to be reset
    :param state: the state
    """
    warnings.warn(
        f"The environment's state was not saved: {state['not_restorable']} The training goes on at an episode's start, and no "
        "longer equals one that was never interrupted.",
        stacklevel=2,
    )
    model._last_obs = None
    assert model.replay_buffer is not None
    end_last_episode(model.replay_buffer)
    normalizer = model.get_vec_normalize_env()
    if normalizer is not None and state["statistics"] is not None:
        set_plain_attributes(normalizer, state["statistics"])


def fill_replay_buffer(buffer: ReplayBuffer, state: State) -> None:
    """
    Fill an empty replay buffer with the transitions that were saved.

    :param buffer: the buffer
    :param state: the buffer's part of the state
    :raises ValueError: if it is of another class, or too small for them
    """
    name = type(buffer).__name__
    require(name == state["class"], "replay_buffer_class", name, f"{state['class']}, as was saved")
    arrays = dict(_row_arrays(buffer))
    for path, rows in state["rows"].items():
        fits = path in arrays and len(rows) <= len(arrays[path]) and rows.shape[1:] == arrays[path].shape[1:]
        shape = arrays[path].shape if path in arrays else None
        require(fits, f"replay_buffer.{path}", shape, f"of a shape that {rows.shape} fits into")
        arrays[path][: len(rows)] = th.from_numpy(rows) if isinstance(arrays[path], th.Tensor) else rows
    set_plain_attributes(buffer, state["attributes"])


def check_replay_buffer(buffer: ReplayBuffer) -> None:
    """
    See that a replay buffer can be saved.

    :param buffer: the buffer
    :raises ValueError: if it keeps the environment's information, which may be anything, or has a state of another kind
    """
    copies = isinstance(buffer, HerReplayBuffer) and buffer.copy_info_dict
    require(not copies, "copy_info_dict", copies, "False where the training is saved")
    state = _replay_state(buffer)
    saved = {path.partition(".")[0] for path in state["rows"]} | set(state["attributes"]) | {"infos"}
    for name, value in vars(buffer).items():
        is_saved = name in saved or isinstance(value, STATELESS_TYPES)
        require(is_saved, f"replay_buffer.{name}", value, "plain data or an array where the training is saved")


def walk(callback: BaseCallback) -> list[BaseCallback]:
    """
    List a callback and those within it.

    :param callback: the callback
    :return: the callbacks, each before those within it, and once
    """
    found = [callback]
    # What is found is looked at in its turn
    for each in found:
        for value in vars(each).values():
            children = value if isinstance(value, list) else [value]
            found += [child for child in children if isinstance(child, BaseCallback) and child not in found]
    return found


def _replay_state(buffer: ReplayBuffer) -> State:
    # The row after the last one holds its next observation where memory is saved
    n_rows = buffer.buffer_size if buffer.full else min(buffer.pos + 1, buffer.buffer_size)
    arrays = dict(_row_arrays(buffer))
    rows = {path: array[:n_rows] for path, array in arrays.items()}
    return {
        "class": type(buffer).__name__,
        "rows": {path: array.numpy(force=True) if isinstance(array, th.Tensor) else array for path, array in rows.items()},
        "attributes": plain_attributes(buffer, without={"infos", *(path.partition(".")[0] for path in arrays)}),
    }


def _row_arrays(buffer: ReplayBuffer) -> Iterator[tuple[str, Any]]:
    """List a buffer's arrays, or tensors, of a row for each step."""
    for name, value in vars(buffer).items():
        fields = {f"{name}.{key}": field for key, field in value.items()} if isinstance(value, dict) else {name: value}
        for path, field in fields.items():
            is_array = isinstance(field, th.Tensor) or (isinstance(field, np.ndarray) and field.dtype != object)
            if is_array and field.ndim > 1 and len(field) == buffer.buffer_size:
                yield path, field


def _callback_state(callback: BaseCallback, training_env: VecEnv) -> State:
    """Save a callback's own counters, and the environments that it evaluates on."""
    environments = {
        name: environment_state(value)
        for name, value in vars(callback).items()
        if isinstance(value, VecEnv) and value is not training_env
    }
    state: State = {"class": _class_name(callback), "environments": environments}
    if hasattr(callback, "get_training_state"):
        return state | {"own": callback.get_training_state()}
    return state | {"attributes": plain_attributes(callback, without={"locals", "globals", *_arguments(type(callback))})}


def _restore_callbacks(callback: BaseCallback, states: list[State]) -> None:
    """Restore callbacks by their class and order."""
    present: dict[tuple[str, int], BaseCallback] = {}
    seen: Counter[str] = Counter()
    for each in walk(callback):
        present[_class_name(each), seen[_class_name(each)]] = each
        seen[_class_name(each)] += 1
    saved: Counter[str] = Counter()
    for state in states:
        name = state["class"]
        found = present.get((name, saved[name]))
        saved[name] += 1
        if found is None:
            if state["environments"] or not name.startswith("stable_baselines3."):
                warnings.warn(f"A {name} was among the callbacks, and is not now: what it counted is lost.", stacklevel=2)
            continue
        if "own" in state:
            found.set_training_state(state["own"])  # type: ignore[attr-defined]
        else:
            set_plain_attributes(found, state["attributes"])
        for attribute, environment in state["environments"].items():
            if environment is None:
                message = f"The state of {name}'s `{attribute}` is not known: its episodes are others than without a stop."
                warnings.warn(message, stacklevel=2)
            elif isinstance(getattr(found, attribute, None), VecEnv):
                restore_environment(getattr(found, attribute), environment)


def _class_name(thing: object) -> str:
    return f"{type(thing).__module__}.{type(thing).__qualname__}"


def _arguments(callback_class: type) -> set[str]:
    """List the arguments of a class's constructors: whoever makes the callback anew says them anew."""
    return {name for each in callback_class.__mro__ for name in inspect.signature(each).parameters if each is not object}


def _all_but(thing: object, names: tuple[str, ...]) -> set[str]:
    return set(vars(thing)) - set(names)


def _pending(logger: Logger) -> State:
    """Save what is recorded and not yet written, but for pictures and the like."""
    plain = {key: value for key, value in logger.name_to_value.items() if isinstance(value, (int, float, str, np.generic))}
    return {
        "name_to_value": plain,
        "name_to_count": {key: logger.name_to_count[key] for key in plain if key in logger.name_to_count},
        "name_to_excluded": {key: logger.name_to_excluded[key] for key in plain if key in logger.name_to_excluded},
    }


def _random_state(model: "ResumableAlgorithm") -> State:
    return {
        "python": random.getstate(),
        "numpy": np.random.get_state(),  # noqa: NPY002  # SB3's generator
        "torch": th.get_rng_state(),
        "cuda": th.cuda.get_rng_state_all() if th.cuda.is_available() else [],
        "action_space": model.action_space.np_random.bit_generator.state,
    }


def _restore_random(model: "ResumableAlgorithm", state: State) -> None:
    random.setstate(state["python"])
    np.random.set_state(state["numpy"])  # noqa: NPY002
    th.set_rng_state(state["torch"])
    for index, cuda_state in enumerate(state["cuda"][: th.cuda.device_count()]):
        th.cuda.set_rng_state(cuda_state, index)
    model.action_space.np_random.bit_generator.state = state["action_space"]
