"""Observations that a ``DummyVecEnv`` would change before anything else sees them."""

import copy
import functools
import weakref
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, TypeVar

import gymnasium as gym
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

from sb3_cgp.guards.explanations import check_reset_info
from sb3_cgp.guards.observations import innermost
from sb3_cgp.guards.transitions import check_final_observation, check_shape

SelfDummyVecEnvGuard = TypeVar("SelfDummyVecEnvGuard", bound="DummyVecEnvGuard")


class DummyVecEnvGuard(OffPolicyAlgorithm):
    """
    An algorithm that sees the observations of a ``DummyVecEnv`` as its environments return them.

    It refuses those that NumPy would broadcast to the array in which a ``DummyVecEnv`` collects them. It checks an episode's
    final one before ``VecNormalize`` clips it, and copies it before the environment's ``reset`` can overwrite it.
    """

    def learn(self: SelfDummyVecEnvGuard, *args: Any, **kwargs: Any) -> SelfDummyVecEnvGuard:
        """
        Learn from the observations that the environments return.

        :param args: the algorithm's own arguments
        :param kwargs: the algorithm's own arguments
        :return: the trained model
        :raises ValueError: if an observation is of a wrong shape, or ``reset`` returns no dictionary beside it
        """
        env = innermost(self.env)
        if not isinstance(env, DummyVecEnv):
            return super().learn(*args, **kwargs)
        with ExitStack() as stack:
            # A private method, as nothing outside of the environment sees an observation before it is collected
            observer = _ObservationObserver(env, self, is_clipped=_sees_raw(self.get_vec_normalize_env()))
            stack.enter_context(_shadowed(env, "_save_obs", observer.save))
            for index, each in enumerate(env.envs):
                stack.enter_context(_shadowed(each, "reset", functools.partial(observer.reset, index, each.reset)))
            return super().learn(*args, **kwargs)


class _ObservationObserver:
    """
    See each observation before a ``DummyVecEnv`` collects it. A copy that is made during a training checks nothing.

    :param env: the environment
    :param model: the model that is learning
    :param is_clipped: whether ``VecNormalize`` receives the observations as they are, and would clip infinite ones
    """

    def __init__(self, env: DummyVecEnv, model: OffPolicyAlgorithm, is_clipped: bool):
        self._env, self._is_clipped = env, is_clipped
        self._model: weakref.ref[OffPolicyAlgorithm] | None = weakref.ref(model)

    def save(self, env_idx: int, obs: Any) -> None:
        """
        Collect an observation.

        :param env_idx: the environment's index
        :param obs: its observation
        :raises ValueError: if it is of a wrong shape, or ``reset`` returns no dictionary beside it
        """
        model = None if self._model is None else self._model()
        if model is not None:
            check_reset_info(self._env.reset_infos[env_idx])
            check_shape("observation", obs, self._env.observation_space, None, model.num_timesteps)
        type(self._env)._save_obs(self._env, env_idx, obs)

    def reset(self, env_idx: int, reset: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """
        Reset one of the environments, after checking and copying its episode's final observation, which it may overwrite.

        ``VecNormalize`` would broadcast and clip that observation before any other check.

        :param env_idx: the environment's index
        :param reset: its own method
        :param args: the arguments of that
        :param kwargs: the same by keyword
        :return: what that returns
        :raises ValueError: if the final observation is of a wrong shape, NaN or infinite
        """
        info = self._env.buf_infos[env_idx]
        # Taken out, so that the next reset does not find one that is refused
        final = info.pop("terminal_observation", None)
        if final is not None:
            model = None if self._model is None else self._model()
            if model is not None:
                space, timestep = self._env.observation_space, model.num_timesteps + self._env.num_envs
                if self._is_clipped:
                    check_final_observation(final, space, timestep)
                else:
                    check_shape("terminal observation", final, space, None, timestep)
            info["terminal_observation"] = copy.deepcopy(final)
        return reset(*args, **kwargs)

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"_model": None}


def _sees_raw(normalizer: VecNormalize | None) -> bool:
    """Return whether a ``VecNormalize`` receives the observations of a ``DummyVecEnv``, which no other wrapper changes."""
    inner = None if normalizer is None else normalizer.venv
    while isinstance(inner, VecMonitor):
        inner = inner.venv
    return isinstance(inner, DummyVecEnv)


@contextmanager
def _shadowed(owner: DummyVecEnv | gym.Env, name: str, method: Any) -> Iterator[None]:
    """Put a method in the place of an object's own for a time, in which a nested training may do the same."""
    # Not by `setattr`, which a wrapper may forward to what it wraps
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
