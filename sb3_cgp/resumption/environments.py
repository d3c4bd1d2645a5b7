"""
The whole state of an environment, and back: from there on it returns the same, to the bit.

What is known to be restorable:

- Gymnasium's classic control and MuJoCo tasks (of models without plugins, flexible bodies and sleeping),
- the wrappers of Gymnasium, of ``rl_zoo3.wrappers`` and of ``sb3_contrib.common.wrappers``, and SB3's ``Monitor``,
- SB3's vectorised environments and their wrappers; within ``SubprocVecEnv``, environments whose outermost wrapper is
  :class:`RestorableEnv`,
- whatever else, environment, wrapper or vectorised environment, has two methods of its own:
  ``get_training_state()`` returns the object's state as plain data (see :func:`to_plain`), or ``None``
  if it cannot be restored now, and ``set_training_state(state)`` puts it back; both may be called before the first
  ``reset``. An environment within a wrapper has its own; ``np_random``, the spaces' random generators and a MuJoCo
  environment's ``data`` are saved along with it.

Specs, spaces (but for their random generators), renderers, files, modules and functions are taken to hold no state, and the
time on the clock, what an environment was constructed with and how it is rendered to be no part of it. Anything else that
is no plain data makes an environment one that cannot be restored. Python's and NumPy's global random generators belong to
the process: those of ``SubprocVecEnv``'s workers are saved here, the training process's own are the caller's to save.
"""

import io
import random
from collections.abc import Iterator
from functools import partial
from types import BuiltinFunctionType, FunctionType, MethodType, ModuleType
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from stable_baselines3.common.monitor import ResultsWriter
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecEnvWrapper, VecFrameStack
from stable_baselines3.common.vec_env.stacked_observations import StackedObservations

from sb3_cgp.common.rules import require
from sb3_cgp.resumption.plain_data import NotPlainError, from_plain, plain_attributes, set_plain_attributes, to_plain

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
# MuJoCo's model does not change, and its data is saved apart
STATELESS_MODULES = ("gymnasium.envs.mujoco.mujoco_rendering.", "mujoco.", "pygame.")
UNSAVED = {
    # What is inside, a state of its own
    *("env", "envs", "venv", "obs_spaces", "sub_stacked_observations"),
    # Between two steps, it waits for nobody
    "actions",
    # SubprocVecEnv's connections
    *("closed", "processes", "remotes", "waiting", "work_remotes"),
    # Of the class, and what the constructor was called with
    *("class_attributes", "_ezpickle_args", "_ezpickle_kwargs", "_saved_kwargs", "fullpath"),
    # Rendering, and the clock
    *("metadata", "render_mode", "frame_list", "recorded_frames", "render_history", "episode_start_time", "t_start"),
}
# What the environment said last may hold anything, and is overwritten rather than read
INFOS = {"buf_infos", "reset_infos"}
RANDOM_STATE = {"_np_random", "_np_random_seed"}


class RestorableEnv(gym.Wrapper):
    """
    Lets a process that holds an environment in a ``SubprocVecEnv`` save and restore it. Elsewhere it does nothing.

    It has to be the outermost wrapper, as it cannot reach what is around it: the last one of rl_zoo3's ``env_wrapper``.

    :param env: the environment
    """

    def get_chain_state(self) -> dict[str, Any] | str:
        """
        Copy the state of the environment within, of all its wrappers, and of the process's random generators.

        :return: plain data, or what is in the way if the environment cannot be restored: an error would end the process
        """
        try:
            state = _chain_state(self)
        except (NotPlainError, ValueError) as error:
            return str(error)
        # Wrappers draw from NumPy's global generator, as rl_zoo3's ActionNoiseWrapper does
        return state | {"random": random.getstate(), "np_random": np.random.get_state()}  # noqa: NPY002

    def set_chain_state(self, state: dict[str, Any]) -> None:
        """
        Put back what :meth:`get_chain_state` of an environment made in the same way returned.

        :param state: the state
        """
        _set_chain_state(self, state)
        random.setstate(state["random"])
        np.random.set_state(state["np_random"])  # noqa: NPY002


def environment_state(env: VecEnv) -> dict[str, Any] | None:
    """
    Copy the whole state of a vectorised environment, its wrappers and its environments.

    :param env: the environment, as it is between two steps
    :return: plain data (see :func:`to_plain`), or None if the environment cannot be restored, see
        :mod:`sb3_cgp.resumption.environments`
    :raises ValueError: if a ``get_training_state()`` returns anything but plain data
    """
    try:
        return _state(env)
    except NotPlainError:
        return None


def why_not_restorable(env: VecEnv) -> str | None:
    """
    Say why :func:`environment_state` returns None.

    :param env: the environment
    :return: a sentence that names what is in the way, or None if nothing is
    :raises ValueError: if a ``get_training_state()`` returns anything but plain data
    """
    try:
        _state(env)
    except NotPlainError as error:
        return str(error)
    return None


def restore_environment(env: VecEnv, state: dict[str, Any]) -> None:
    """
    Put the state of one vectorised environment into another one that was made in the same way.

    It need not have been reset. From then on both return the same observations, rewards, ends of episodes and infos for
    the same actions and start later episodes alike, to the bit; only the times on the clock differ.

    :param env: the environment to change
    :param state: what :func:`environment_state` returned
    :raises ValueError: if the state is of another environment; this one is then as it was
    """
    try:
        there = _state(env)
    except NotPlainError as error:
        raise ValueError(f"The value of `env` is {env!r}, but must be restorable: {error}") from error
    _require_same(there, state)
    layers = list(_vec_layers(env))
    for layer, layer_state in zip(layers, state["layers"], strict=True):
        _set_layer_state(layer, layer_state)
    base = layers[-1]
    for index, chain_state in enumerate(state["envs"]):
        if isinstance(base, SubprocVecEnv):
            base.env_method("set_chain_state", chain_state, indices=index)
        else:
            _set_chain_state(base.envs[index], chain_state)


def _state(env: VecEnv) -> dict[str, Any]:
    """Copy the whole state of a vectorised environment; NotPlainError says why that is not possible."""
    layers = list(_vec_layers(env))
    base, chains = layers[-1], []
    if isinstance(base, DummyVecEnv):
        chains = [_chain_state(each) for each in base.envs]
    if isinstance(base, SubprocVecEnv):
        # `env_method` finds methods through wrappers, but the outermost object's own `__dir__` first of all
        if not all("get_chain_state" in names for names in base.env_method("__dir__")):
            raise NotPlainError("An environment of SubprocVecEnv has no RestorableEnv outermost.")
        chains = base.env_method("get_chain_state")
        for chain in chains:
            if isinstance(chain, str):
                raise NotPlainError(chain)
    return {"num_envs": env.num_envs, "layers": [_layer_state(layer) for layer in layers], "envs": chains}


def _vec_layers(env: VecEnv) -> Iterator[Any]:
    """Walk a vectorised environment from the outermost wrapper to the innermost."""
    yield env
    if isinstance(env, VecFrameStack):
        yield from _stacks(env.stacked_obs)
    if isinstance(env, VecEnvWrapper):
        yield from _vec_layers(env.venv)


def _stacks(stack: StackedObservations) -> Iterator[StackedObservations]:
    """Find where frames are stacked: in one place, or in one for each key of a Dict's."""
    yield stack
    for each in vars(stack).get("sub_stacked_observations", {}).values():
        yield from _stacks(each)


def _chain(env: gym.Env) -> Iterator[gym.Env]:
    """Walk an environment from the outermost wrapper to the innermost."""
    yield env
    if isinstance(env, gym.Wrapper):
        yield from _chain(env.env)


def _chain_state(env: gym.Env) -> dict[str, Any]:
    """Copy the state of an environment and its wrappers."""
    return {"layers": [_layer_state(layer) for layer in _chain(env)]}


def _set_chain_state(env: gym.Env, state: dict[str, Any]) -> None:
    """Put back the state of an environment and its wrappers."""
    for layer, layer_state in zip(_chain(env), state["layers"], strict=True):
        _set_layer_state(layer, layer_state)


def _layer_state(layer: Any) -> dict[str, Any]:
    """Copy the state of one environment or wrapper without what is inside; NotPlainError says why that is not possible."""
    kind = type(layer)
    state: dict[str, Any] = {"class": f"{kind.__module__}.{kind.__qualname__}"}
    # Of the class: the vectorised environments' wrappers seem to have all that is inside
    if hasattr(kind, "get_training_state"):
        own = layer.get_training_state()
        if own is None:
            raise NotPlainError(f"{state['class']}.get_training_state() returned None.")
        try:
            state["own"] = to_plain(own)
        except NotPlainError as error:
            message = f"{state['class']}.get_training_state() returned {own!r}, but must return plain data: {error}"
            raise ValueError(message) from error
        state["attributes"] = plain_attributes(layer, without=vars(layer).keys() - RANDOM_STATE)
    else:
        if not _is_of(layer, RESTORABLE_MODULES):
            raise NotPlainError(f"{state['class']} is unknown and has no get_training_state().")
        state["attributes"] = plain_attributes(layer, UNSAVED)
        for name in vars(layer).keys() - state["attributes"].keys() - UNSAVED - INFOS:
            if not _is_stateless(vars(layer)[name]):
                raise NotPlainError(f"{state['class']}.{name} is {vars(layer)[name]!r}, which is no plain data.")
    state["spaces"] = {name: _space_state(value) for name, value in vars(layer).items() if isinstance(value, spaces.Space)}
    data = _mujoco_data(layer)
    if data is not None:
        if not _is_whole(data.model):
            raise NotPlainError(f"{state['class']} has a MuJoCo model with plugins, flexible bodies or sleep.")
        state["mujoco"] = {name: field.copy() for name, field in _mujoco_fields(data)} | {"time": data.time}
    return state


def _set_layer_state(layer: Any, state: dict[str, Any]) -> None:
    """Put back the state of one environment or wrapper."""
    # First, as it may draw random numbers
    if "own" in state:
        layer.set_training_state(from_plain(state["own"]))
    set_plain_attributes(layer, state["attributes"])
    for name, space_state in state["spaces"].items():
        _set_space_state(vars(layer)[name], space_state)
    data = _mujoco_data(layer)
    if data is not None:
        data.time = state["mujoco"]["time"]
        for name, field in _mujoco_fields(data):
            field[...] = state["mujoco"][name]


def _is_of(value: Any, modules: tuple[str, ...]) -> bool:
    """Tell whether a value's class is of one of these modules."""
    return f"{type(value).__module__}.".startswith(modules)


def _is_stateless(value: Any) -> bool:
    """Tell whether a value is of a kind that holds no state, or whose state is saved apart."""
    return isinstance(value, STATELESS_TYPES) or _is_of(value, STATELESS_MODULES)


def _inside(space: spaces.Space) -> list[spaces.Space]:
    """Find the spaces that a space is made of."""
    found: list[Any] = []
    for value in vars(space).values():
        found.extend(value.values() if isinstance(value, dict) else value if isinstance(value, tuple | list) else [value])
    return [each for each in found if isinstance(each, spaces.Space)]


def _space_state(space: spaces.Space) -> dict[str, Any]:
    """Copy the states of a space's random generators."""
    # Not `np_random`, which makes a generator where there is none yet
    random_state = {name: to_plain(value) for name, value in vars(space).items() if name in RANDOM_STATE}
    return {"space": str(space), "attributes": random_state, "inside": [_space_state(each) for each in _inside(space)]}


def _set_space_state(space: spaces.Space, state: dict[str, Any]) -> None:
    """Put back the states of a space's random generators."""
    set_plain_attributes(space, state["attributes"])
    for each, inside in zip(_inside(space), state["inside"], strict=True):
        _set_space_state(each, inside)


def _mujoco_data(layer: Any) -> Any:
    """Find a MuJoCo environment's data; importing MuJoCo to ask for its class takes long."""
    data = vars(layer).get("data")
    return data if data is not None and _is_of(data, ("mujoco.",)) else None


def _is_whole(model: Any) -> bool:
    """Tell whether MuJoCo's fields of numbers are all that it steps from: plugins, flexible bodies and sleep have more."""
    import mujoco

    # Newer than the oldest MuJoCo that Gymnasium works with
    sleep = getattr(mujoco.mjtEnableBit, "mjENBL_SLEEP", 0)
    return not (model.nplugin or getattr(model, "nflex", 0) or model.opt.enableflags & int(sleep))


def _mujoco_fields(data: Any) -> Iterator[tuple[str, np.ndarray]]:
    """
    Find the fields that MuJoCo steps from and that environments read before the next step, as arrays to write to.

    These are all fields of floats and flags in its main buffer, which ``qpos`` is the first of, the derived ones among
    them. Each step computes anew, before it reads them, the indices of the main buffer and all that is in the arena, such as
    the contacts; neither is safe to write to.
    """
    start = data.qpos.__array_interface__["data"][0]
    for name in dir(data):
        field = None if name.startswith("_") else getattr(data, name)
        if isinstance(field, np.ndarray) and field.size and field.dtype.kind in "fb":
            offset = field.__array_interface__["data"][0] - start
            if 0 <= offset < data.nbuffer:
                yield name, field


def _describe(state: dict[str, Any]) -> str:
    """Name the classes that an environment is made of, from the outermost to the innermost."""
    vectorized, *chains = [" > ".join(layer["class"] for layer in each["layers"]) for each in (state, *state["envs"])]
    # Most often they are all the same
    inside = " | ".join(dict.fromkeys(chains)) if len(set(chains)) == 1 else " | ".join(chains)
    return f"{state['num_envs']} x {vectorized}" + (f" > {inside}" if inside else "")


def _require_same(there: dict[str, Any], saved: dict[str, Any]) -> None:
    """Refuse the state of an environment that was made in another way."""
    is_what = "what the state was saved from"
    require(_describe(there) == _describe(saved), "env", _describe(there), f"{is_what}, {_describe(saved)!r}")
    layers = [[layer for each in (state, *state["envs"]) for layer in each["layers"]] for state in (there, saved)]
    for ours, theirs in zip(*layers, strict=True):
        for part, describe in (
            ("spaces", lambda state: state["space"]),
            ("mujoco", lambda field: f"of shape {np.shape(field)}"),
        ):
            our, their = ({name: describe(each) for name, each in layer.get(part, {}).items()} for layer in (ours, theirs))
            for name in sorted(our.keys() | their.keys()):
                allowed = f"{is_what}, {their.get(name)!r}"
                require(our.get(name) == their.get(name), f"{ours['class']}.{name}", our.get(name), allowed)
