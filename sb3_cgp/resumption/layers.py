"""The state of one environment or wrapper, without the environment that it wraps."""

import io
from collections.abc import Set
from functools import partial
from itertools import combinations
from types import BuiltinFunctionType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.wrappers import PassiveEnvChecker
from stable_baselines3.common.monitor import ResultsWriter
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.stacked_observations import StackedObservations

from sb3_cgp.common.sb3_arguments import constructor_argument_names
from sb3_cgp.resumption.declarations import METHODS, OWN, Declaration, Obstacle, find_declaration, full_name
from sb3_cgp.resumption.mujoco_data import (
    get_mujoco_data,
    is_restorable,
    is_view,
    model_state,
    mujoco_state,
    set_model_state,
    set_mujoco_state,
)
from sb3_cgp.resumption.plain_data import declared_state, from_plain, plain_attributes, set_plain_attributes, to_plain

RESTORABLE_MODULES = (
    "gymnasium.envs.classic_control.",
    "gymnasium.envs.mujoco.",
    "gymnasium.wrappers.",
    "rl_zoo3.gym_patches.",
    "rl_zoo3.wrappers.",
    "sb3_cgp.resumption.environments.",
    "sb3_contrib.common.wrappers.",
    "stable_baselines3.common.monitor.",
    "stable_baselines3.common.vec_env.",
)
STATELESS_TYPES = (
    *(BuiltinFunctionType, EnvSpec, FunctionType, MethodType, ModuleType, ResultsWriter, StackedObservations),
    *(io.IOBase, np.dtype, np.ufunc, partial, spaces.Space, type),
)
# MuJoCo's model does not change; its data is saved separately
STATELESS_MODULES = ("gymnasium.envs.mujoco.mujoco_rendering.", "gymnasium_robotics.utils.mujoco_utils.", "mujoco.", "pygame.")
# Attributes without state, by the names of the classes, or of their modules, whose objects and those of subclasses have them
VEC_ENV = "stable_baselines3.common.vec_env."
STATELESS_ATTRIBUTES = {
    # The wrapped environments and stacks, each of which has a state of its own
    "gymnasium.core.Wrapper": {"env"},
    f"{VEC_ENV}base_vec_env.": {"venv", "class_attributes", "metadata", "render_mode"},
    f"{VEC_ENV}stacked_observations.": {"sub_stacked_observations"},
    f"{VEC_ENV}vec_normalize.": {"obs_spaces"},
    # The actions are those of the last completed step
    f"{VEC_ENV}dummy_vec_env.": {"envs", "actions"},
    f"{VEC_ENV}subproc_vec_env.": {"closed", "processes", "remotes", "waiting", "work_remotes"},
    # The constructor's arguments
    "gymnasium.utils.": {"_ezpickle_args", "_ezpickle_kwargs", "_saved_kwargs"},
    "gymnasium.envs.mujoco.": {"fullpath"},
    "gymnasium_robotics.": {"fullpath"},
    # Rendering, and wall-clock times
    "gymnasium.core.Env": {"metadata", "render_mode"},
    "gymnasium.wrappers.": {"frame_list", "recorded_frames", "render_history", "episode_start_time"},
    f"{VEC_ENV}vec_video_recorder.": {"recorded_frames"},
    f"{VEC_ENV}vec_monitor.": {"t_start"},
    "stable_baselines3.common.monitor.": {"t_start"},
}
# SB3's infos of the last step may hold values of any type; they are overwritten before they are read
INFOS = {"buf_infos", "reset_infos"}
# For a `PassiveEnvChecker` whose last infos are no plain data: its checks of the first steps, which only warn, count as done
CHECKED = {"_previous_data": None, "checked_step": True, "checked_data_reuse": True}
RANDOM_STATE = {"_np_random", "_np_random_seed"}
# They do not change their MuJoCo models; environments of others may
CONSTANT_MODELS = "gymnasium.envs.mujoco."


def layer_state(layer: Any, problems: list[Obstacle], is_replayed: bool = False) -> dict[str, Any]:
    """
    Copy the state of one environment or wrapper, without the environment that it wraps.

    :param layer: the environment or wrapper
    :param problems: a list to which each obstacle is appended
    :param is_replayed: whether a wrapper around the layer repeats its episode: its random generators alone are then copied
    :return: plain data, from which the layer can be restored if no obstacle was appended
    :raises ValueError: if ``get_training_state()`` returns anything but plain data
    """
    kind = type(layer)
    name = full_name(kind)
    state: dict[str, Any] = {"class": name}
    # Looked up in the class, as wrappers of vectorised environments forward the attributes of the wrapped one
    declaration = find_declaration(kind)
    if is_replayed:
        state["attributes"] = plain_attributes(layer, without=vars(layer).keys() - RANDOM_STATE)
    elif declaration is not None and declaration.get is not None:
        state["own"] = _own_state(layer, name, declaration, problems)
        state["attributes"] = plain_attributes(layer, without=vars(layer).keys() - RANDOM_STATE)
    else:
        unsaved = _unsaved(kind)
        state["attributes"] = plain_attributes(layer, unsaved)
        if kind is PassiveEnvChecker and "_previous_data" not in state["attributes"]:
            state["attributes"] |= CHECKED
        is_declared = declaration is not None
        problems.extend(_problems(layer, name, state["attributes"].keys() | unsaved, is_declared))
    # By which a difference is noticed, as an attribute often is a value that the user gave to the constructor
    arguments = constructor_argument_names(kind)
    state["arguments"] = [key for key in state["attributes"] if key.removeprefix("_") in arguments]
    state["spaces"] = {key: _space_state(value) for key, value in vars(layer).items() if isinstance(value, spaces.Space)}
    data = None if is_replayed else get_mujoco_data(layer)
    if data is not None:
        if is_restorable(data):
            state["mujoco"] = mujoco_state(data)
            if not name.startswith(CONSTANT_MODELS):
                state["mujoco_model"] = model_state(data.model)
        else:
            problems.append(Obstacle(f"{name} has a MuJoCo model with plugins, flexible bodies or sleep."))
    return state


def set_layer_state(layer: Any, state: dict[str, Any]) -> None:
    """
    Restore the state of one environment or wrapper.

    :param layer: the environment or wrapper
    :param state: the state that :func:`layer_state` returned
    """
    # First, as this method may draw random numbers
    if "own" in state:
        declaration = find_declaration(type(layer))
        assert declaration is not None
        assert declaration.set is not None
        declaration.set(layer, from_plain(state["own"]))
    set_plain_attributes(layer, state["attributes"])
    for name, space_state in state["spaces"].items():
        _set_space_state(vars(layer)[name], space_state)
    data = get_mujoco_data(layer)
    if data is not None and "mujoco" in state:
        set_mujoco_state(data, state["mujoco"])
        if "mujoco_model" in state:
            set_model_state(data.model, state["mujoco_model"])


def _own_state(layer: Any, name: str, declaration: Declaration, problems: list[Obstacle]) -> Any:
    assert declaration.get is not None
    own = declaration.get(layer)
    described = f"{name}{declaration.described}"
    if own is None:
        problems.append(Obstacle(f"{described} returned None."))
    if declaration is OWN and not hasattr(type(layer), "set_training_state"):
        problems.append(Obstacle(f"{name} has a get_training_state() and no set_training_state(): it needs {METHODS}."))
    return declared_state(described, own)


def _is_known(kind: type) -> bool:
    """Return whether the environments and wrappers of a class's module are known to be restorable."""
    return f"{kind.__module__}.".startswith(RESTORABLE_MODULES)


def _unsaved(kind: type) -> set[str]:
    """Return the names of the attributes of a class that have no state."""
    bases = [full_name(base) for base in kind.__mro__]
    return set().union(
        *(names for origin, names in STATELESS_ATTRIBUTES.items() if any(base.startswith(origin) for base in bases))
    )


def _problems(layer: Any, name: str, handled: Set[str], is_declared: bool) -> list[Obstacle]:
    """Return the obstacles of a layer whose state is its attributes."""
    if not (is_declared or _is_known(type(layer))):
        remedy = f"it needs {METHODS}, or sb3_cgp.register_restorable"
        return [Obstacle(f"{name} is unknown and has no get_training_state(): {remedy}.")]
    others = {key: vars(layer)[key] for key in vars(layer).keys() - handled - (INFOS if isinstance(layer, VecEnv) else set())}
    stateful = {key: value for key, value in sorted(others.items()) if not _is_stateless(value)}
    obstacles = [Obstacle(f"{name}.{key} is {value!r}, which is not plain data.") for key, value in stateful.items()]
    return obstacles if _is_known(type(layer)) else obstacles + _shared(layer, name)


def _shared(layer: Any, name: str) -> list[Obstacle]:
    """Return an obstacle for each array that changes with another one, or with MuJoCo's data: a restored copy would not."""
    arrays = {key: value for key, value in vars(layer).items() if isinstance(value, np.ndarray) and value.size}
    data = get_mujoco_data(layer)
    others = {key: "MuJoCo's data" for key, array in arrays.items() if data is not None and is_view(array, data)}
    for (key, array), (other, view) in combinations(arrays.items(), 2):
        if array is not view and np.shares_memory(array, view):
            others.setdefault(other, f"its {key}")
    remedy = f"it has to be a copy, or the class needs {METHODS}"
    sentences = [f"{name}.{key} shares memory with {other}: {remedy}." for key, other in others.items()]
    # Nothing shared memory when a state was saved
    return [Obstacle(each, prevents_restoring=False) for each in sentences]


def _is_stateless(value: Any) -> bool:
    """Return whether values of this type have no state, or a state that is saved separately."""
    return isinstance(value, STATELESS_TYPES) or f"{type(value).__module__}.".startswith(STATELESS_MODULES)


def _subspaces(space: spaces.Space) -> list[spaces.Space]:
    """List the spaces within a Dict, Tuple or other composite space."""
    found: list[Any] = []
    for value in vars(space).values():
        found.extend(value.values() if isinstance(value, dict) else value if isinstance(value, tuple | list) else [value])
    return [each for each in found if isinstance(each, spaces.Space)]


def _space_state(space: spaces.Space) -> dict[str, Any]:
    """Copy the states of a space's random generators."""
    # Not the property `np_random`, which would create a missing generator
    random_state = {name: to_plain(value) for name, value in vars(space).items() if name in RANDOM_STATE}
    return {"space": str(space), "attributes": random_state, "inside": [_space_state(each) for each in _subspaces(space)]}


def _set_space_state(space: spaces.Space, state: dict[str, Any]) -> None:
    """Restore the states of a space's random generators."""
    set_plain_attributes(space, state["attributes"])
    for each, inside in zip(_subspaces(space), state["inside"], strict=True):
        _set_space_state(each, inside)
