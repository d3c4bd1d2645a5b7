"""Observations that a ``DummyVecEnv`` would change before anything else sees them."""

import copy
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, SupportsIndex

import gymnasium as gym
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

from sb3_cgp.guards.explanations import check_reset_info
from sb3_cgp.guards.observation_fit import check_integers, check_shape
from sb3_cgp.guards.observations import innermost
from sb3_cgp.guards.transitions import check_final_observation


@contextmanager
def observing_environments(model: OffPolicyAlgorithm) -> Iterator[None]:
    """
    See the observations of a ``DummyVecEnv`` as its environments return them.

    Those that NumPy would broadcast to the array in which a ``DummyVecEnv`` collects them, or round or wrap to its integers,
    are refused. An episode's final one is checked before ``VecNormalize`` clips it, and copied before the environment's
    ``reset`` can overwrite it; the latter not in a subclass with a ``step_wait`` that takes no environment from ``envs``
    between its step and its reset.

    :param model: the model that learns within the context
    :raises ValueError: if an observation does not fit its space, or ``reset`` returns no dictionary beside it
    """
    env = innermost(model.env)
    if not isinstance(env, DummyVecEnv):
        yield
        return
    # A private method, as nothing outside of the environment sees an observation before it is collected
    observer = _ObservationObserver(env, model, normalizer_sees_raw=_sees_raw(model.get_vec_normalize_env()))
    with _shadowed(env, "_save_obs", observer.save), _observed(env, observer):
        yield


class _ObservationObserver:
    """
    See each observation before a ``DummyVecEnv`` collects it. A copy that is made during a training checks nothing.

    :param env: the environment
    :param model: the model that is learning
    :param normalizer_sees_raw: whether ``VecNormalize`` receives the observations as they are, and would clip infinite ones
    """

    def __init__(self, env: DummyVecEnv, model: OffPolicyAlgorithm, normalizer_sees_raw: bool):
        self._env, self._normalizer_sees_raw = env, normalizer_sees_raw
        self._model: weakref.ref[OffPolicyAlgorithm] | None = weakref.ref(model)
        # The final observations that have been seen. Of those of before, copies: the environment may use its array again.
        self._seen = [copy.deepcopy(info.get("terminal_observation")) for info in env.buf_infos]
        for info, seen in zip(env.buf_infos, self._seen, strict=True):
            if seen is not None:
                info["terminal_observation"] = seen

    def save(self, env_idx: int, obs: Any) -> None:
        """
        Collect an observation.

        :param env_idx: the environment's index
        :param obs: its observation
        :raises ValueError: if it does not fit its space, or ``reset`` returns no dictionary beside it
        """
        # Where a subclass of ``DummyVecEnv`` has not taken the environment from its list before its reset
        self.save_final(env_idx)
        model = None if self._model is None else self._model()
        if model is not None:
            check_reset_info(self._env.reset_infos[env_idx])
            space = self._env.observation_space
            check_shape("observation", obs, space, None, model.num_timesteps)
            check_integers("observation", obs, space, model.num_timesteps)
        type(self._env)._save_obs(self._env, env_idx, obs)

    def save_final(self, env_idx: int) -> None:
        """
        Check and copy the final observation of an episode that has just ended, before ``reset`` may overwrite it.

        ``VecNormalize`` would broadcast and clip that observation before any other check.

        :param env_idx: the environment's index
        :raises ValueError: if the final observation does not fit its space, or is NaN or infinite
        """
        info = self._env.buf_infos[env_idx]
        final = info.get("terminal_observation")
        model = None if self._model is None else self._model()
        # An environment may have a use of its own for this key
        is_final = final is not None and self._env.buf_dones[env_idx] and final is not self._seen[env_idx]
        if model is None or not is_final:
            return
        # One that is refused is not found by another training on this environment
        del info["terminal_observation"]
        space, timestep = self._env.observation_space, model.num_timesteps + self._env.num_envs
        if self._normalizer_sees_raw:
            check_final_observation(final, space, timestep)
        else:
            check_shape("terminal observation", final, space, None, timestep)
        check_integers("terminal observation", final, space, timestep)
        self._seen[env_idx] = info["terminal_observation"] = copy.deepcopy(final)

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"_model": None}


class _ObservedEnvironments(list[gym.Env]):
    """
    The environments of a ``DummyVecEnv``, which takes each from this list to reset it, once its final observation is known.

    A method in the place of an environment's own ``reset`` would be copied with the environment's attributes. A copy of this
    list is a plain one.

    :param envs: the environments
    :param observer: is told of each access
    """

    def __init__(self, envs: list[gym.Env], observer: _ObservationObserver):
        super().__init__(envs)
        self._observer = observer

    def __getitem__(self, index: Any) -> Any:
        if not isinstance(index, slice):
            self._observer.save_final(index)
        return super().__getitem__(index)

    def __reduce_ex__(self, protocol: SupportsIndex) -> tuple[Any, ...]:
        return list, (list(self),)


@contextmanager
def _observed(env: DummyVecEnv, observer: _ObservationObserver) -> Iterator[None]:
    """Let an observer see the final observations of a ``DummyVecEnv`` for a time."""
    if "envs" not in vars(env):
        # A property of a subclass
        yield
        return
    envs = env.envs
    env.envs = _ObservedEnvironments(envs, observer)
    try:
        yield
    finally:
        if isinstance(envs, list):
            # A callback may have replaced some
            envs[:] = env.envs
        env.envs = envs


def _sees_raw(normalizer: VecNormalize | None) -> bool:
    """Return whether a ``VecNormalize`` receives the observations of a ``DummyVecEnv``, which no other wrapper changes."""
    inner = None if normalizer is None else normalizer.venv
    while isinstance(inner, VecMonitor):
        inner = inner.venv
    return isinstance(inner, DummyVecEnv)


@contextmanager
def _shadowed(owner: DummyVecEnv, name: str, method: Any) -> Iterator[None]:
    """Put a method in the place of an object's own for a time, in which a nested training may do the same."""
    attributes = vars(owner)
    before = attributes.get(name)
    attributes[name] = method
    try:
        yield
    finally:
        if before is None:
            del attributes[name]
        else:
            attributes[name] = before
