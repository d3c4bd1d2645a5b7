"""
The complete state of an environment. A restored environment returns exactly what the saved one would have returned.

These environments and wrappers can be restored:

- Gymnasium's classic control and MuJoCo tasks (of models without plugins, flexible bodies and sleep),
- the wrappers of Gymnasium, of ``rl_zoo3.wrappers`` and of ``sb3_contrib.common.wrappers``, and SB3's ``Monitor``,
- SB3's vectorised environments and their wrappers; within ``SubprocVecEnv``, environments whose outermost wrapper is
  :class:`RestorableEnv`,
- environments that derive from Gymnasium's ``MujocoEnv`` or Gymnasium-Robotics' ``MujocoRobotEnv`` and whose attributes are
  plain data, and tasks of dm_control's suite in shimmy's ``DmControlCompatibilityV0``,
- deterministic environments within :class:`~sb3_cgp.resumption.replayed.ReplayedEnv`, such as Gymnasium's Box2D tasks,
- those of a class that :func:`~sb3_cgp.resumption.declarations.register_restorable` was given,
- any other environment, wrapper or vectorised environment whose class has two methods:
  ``get_training_state()`` returns the object's state as plain data (see :func:`~sb3_cgp.resumption.plain_data.to_plain`),
  or ``None`` if it cannot be restored now, and ``set_training_state(state)`` restores it. Both may be called before the first
  ``reset``. An environment and its wrappers each have their own. ``np_random``, the spaces' random generators and a MuJoCo
  environment's ``data`` are saved without them.

Global random generators belong to the process: those of ``SubprocVecEnv``'s workers are saved here, those of the training
process by the caller.
"""

import random
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecEnvWrapper, VecFrameStack
from stable_baselines3.common.vec_env.stacked_observations import StackedObservations

from sb3_cgp.common.rules import require
from sb3_cgp.resumption.declarations import METHODS, Obstacle, pickle_declarations, unpickle_declarations
from sb3_cgp.resumption.differences import require_same, warn_of_other_arguments
from sb3_cgp.resumption.layers import layer_state, set_layer_state
from sb3_cgp.resumption.replayed import ReplayedEnv

WITHOUT_WRAPPER = (
    "An environment of SubprocVecEnv has no RestorableEnv outermost. Make sb3_cgp.resumption.RestorableEnv its outermost "
    f"wrapper; an environment outside of the table in docs/trust.md needs {METHODS}, or sb3_cgp.register_restorable, too."
)


class RestorableEnv(gym.Wrapper):
    """
    Save and restore an environment in a process of a ``SubprocVecEnv``. Elsewhere this wrapper does nothing.

    It must be the outermost wrapper, the last one of rl_zoo3's ``env_wrapper``, as it cannot reach wrappers around it.

    :param env: the environment
    """

    def get_chain_state(self, declarations: list[bytes]) -> tuple[dict[str, Any], list[Obstacle]]:
        """
        Copy the state of the wrapped environment, of all its wrappers, and of the process's random generators.

        :param declarations: those of the training's process, as ``pickle_declarations`` returned them
        :return: plain data, and the obstacles, errors among them, as an error would end the process
        """
        problems: list[Obstacle] = []
        try:
            unpickle_declarations(declarations)
            state = _chain_state(self, problems)
        except Exception as error:
            return {}, [Obstacle(f"{type(error).__name__}: {error}")]
        # Wrappers draw from NumPy's global generator, as rl_zoo3's ActionNoiseWrapper does
        return state | {"random": random.getstate(), "np_random": np.random.get_state()}, problems  # noqa: NPY002

    def set_chain_state(self, state: dict[str, Any]) -> None:
        """
        Restore the state that :meth:`get_chain_state` of an environment made in the same way returned.

        :param state: the state
        """
        _set_chain_state(self, state)
        random.setstate(state["random"])
        np.random.set_state(state["np_random"])  # noqa: NPY002


def state_and_obstacles(env: VecEnv | gym.Env) -> tuple[dict[str, Any] | None, list[str]]:
    """
    Copy the complete state of an environment, its wrappers and its environments, or say why it cannot be restored.

    :param env: the environment, vectorised or not, between two steps
    :return: plain data (see :func:`~sb3_cgp.resumption.plain_data.to_plain`), or None if the environment cannot be restored;
        and a sentence or two for each obstacle, with what would help
    :raises ValueError: if a ``get_training_state()`` returns anything but plain data
    """
    state, problems = _state(env)
    return None if problems else state, [each.text for each in problems]


def _state(env: VecEnv | gym.Env) -> tuple[dict[str, Any], list[Obstacle]]:
    problems: list[Obstacle] = []
    layers, envs = _parts(env)
    states = [layer_state(layer, problems) for layer in layers]
    in_processes = layers and isinstance(layers[-1], SubprocVecEnv)
    chains = _states_in_processes(layers[-1], problems) if in_processes else [_chain_state(each, problems) for each in envs]
    state = {"num_envs": 1 if isinstance(env, gym.Env) else env.num_envs, "layers": states, "envs": chains}
    return state, list(dict.fromkeys(problems))


def restore_environment(env: VecEnv | gym.Env, state: dict[str, Any]) -> None:
    """
    Restore the state of an environment in another one that was made in the same way.

    The other environment need not have been reset. Given the same actions, both then return exactly the same observations,
    rewards, ends of episodes and infos, in this and in later episodes. Only wall-clock times differ. A warning names
    arguments with which the other environment was made in another way, and which are restored, too.

    :param env: the environment to change
    :param state: the state that :func:`state_and_obstacles` returned
    :raises ValueError: if the state is that of another environment; ``env`` is then not changed
    """
    current, found = _state(env)
    layers, envs = _parts(env)
    problems = [each.text for each in found if each.prevents_restoring]
    require(not problems, "env", env, f"restorable: {' '.join(problems)}")
    require_same(current, state)
    warn_of_other_arguments(current, state)
    for layer, saved in zip(layers, state["layers"], strict=True):
        set_layer_state(layer, saved)
    for index, chain_state in enumerate(state["envs"]):
        if envs:
            _set_chain_state(envs[index], chain_state)
        else:
            layers[-1].env_method("set_chain_state", chain_state, indices=index)


def _states_in_processes(env: SubprocVecEnv, problems: list[Obstacle]) -> list[dict[str, Any]]:
    # `env_method` searches the wrappers, too. Every object has a `__dir__`, so that this call reaches the outermost one.
    if not all("get_chain_state" in names for names in env.env_method("__dir__")):
        problems.append(Obstacle(WITHOUT_WRAPPER))
        return []
    replies = env.env_method("get_chain_state", pickle_declarations(problems))
    for _, obstacles in replies:
        problems.extend(obstacles)
    return [state for state, _ in replies]


def _parts(env: VecEnv | gym.Env) -> tuple[list[Any], list[gym.Env]]:
    """List the layers of a vectorised environment, and the environments in this process: itself if it is not vectorised."""
    if isinstance(env, gym.Env):
        return [], [env]
    layers = list(_vec_layers(env))
    return layers, layers[-1].envs if isinstance(layers[-1], DummyVecEnv) else []


def is_part_of(env: VecEnv | gym.Env, whole: VecEnv) -> bool:
    """
    Return whether an environment is a vectorised environment, one of its wrappers or environments, or a layer of one.

    :param env: the environment
    :param whole: the vectorised environment
    :return: whether it is; False for environments in other processes
    """
    layers, envs = _parts(whole)
    return any(env is each for each in layers) or any(env is layer for each in envs for layer in _chain(each))


def _vec_layers(env: VecEnv) -> Iterator[Any]:
    """List a vectorised environment's layers from the outermost wrapper to the innermost."""
    yield env
    if isinstance(env, VecFrameStack):
        yield from _stacks(env.stacked_obs)
    if isinstance(env, VecEnvWrapper):
        yield from _vec_layers(env.venv)


def _stacks(stack: StackedObservations) -> Iterator[StackedObservations]:
    """List the stacks of frames: one, or one for each key of a Dict space."""
    yield stack
    for each in vars(stack).get("sub_stacked_observations", {}).values():
        yield from _stacks(each)


def _chain(env: gym.Env) -> Iterator[gym.Env]:
    """List an environment's layers from the outermost wrapper to the innermost."""
    yield env
    if isinstance(env, gym.Wrapper):
        yield from _chain(env.env)


def _chain_state(env: gym.Env, problems: list[Obstacle]) -> dict[str, Any]:
    """Copy the state of an environment and its wrappers."""
    states, is_replayed = [], False
    for layer in _chain(env):
        states.append(layer_state(layer, problems, is_replayed))
        is_replayed = isinstance(layer, ReplayedEnv)
    return {"layers": states}


def _set_chain_state(env: gym.Env, state: dict[str, Any]) -> None:
    """Restore the state of an environment and its wrappers."""
    for layer, saved in zip(_chain(env), state["layers"], strict=True):
        set_layer_state(layer, saved)
