"""
Ways of stepping many environments at once, each as SB3's ``VecEnv``.

Those of other libraries are adapted here for measurements alone: the adapters have what a training calls at each step, and no
more.
"""

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from sb3_cgp.population import make_population_env


@dataclass(frozen=True)
class Way:
    """
    A way of stepping environments.

    :param title: its name in the table
    :param make: makes the environments from an environment's id, their number, the number of processes (or of threads) and a
        seed
    :param package: a package that has to be installed; None for SB3's and Gymnasium's own ways
    """

    title: str
    make: Callable[[str, int, int, int], VecEnv]
    package: str | None = None

    def reason_missing(self) -> str | None:
        """
        Return why the way cannot be measured.

        :return: the reason; None if it can be measured
        """
        try:
            if self.package is not None:
                importlib.import_module(self.package)
        except ImportError as error:
            return f"not measured: {error}"
        return None


class AdaptedVecEnv(VecEnv):
    """
    What a training calls at each step, for a vectorised environment of another library.

    :param env: the vectorised environment
    :param n_envs: the number of its environments
    :param spaces: observation and action space of one environment
    :param seed: the seed of its first environment, the next ones count from it; None if it has been seeded already
    """

    def __init__(self, env: Any, n_envs: int, spaces: Sequence[gym.Space], seed: int | None = None):
        self._env, self._seed = env, seed
        super().__init__(n_envs, *spaces)

    def reset(self) -> np.ndarray:
        """
        Reset the environments.

        :return: observations
        """
        observations, _ = self._env.reset() if self._seed is None else self._env.reset(seed=self._seed)
        self._seed = None
        return np.asarray(observations)

    def step_async(self, actions: np.ndarray) -> None:
        """
        Remember the actions: the next call takes the step.

        :param actions: an action of each environment
        """
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """
        Take a step.

        :return: observations, rewards, ends of episodes and infos
        """
        observations, rewards, terminations, truncations, info = self._env.step(self._actions)
        dones = terminations | truncations
        infos: list[dict[str, Any]] = [{"TimeLimit.truncated": False} for _ in range(self.num_envs)]
        for index in np.flatnonzero(dones).tolist():
            infos[index]["TimeLimit.truncated"] = bool(truncations[index] and not terminations[index])
            observations[index] = self._end_episode(index, observations, infos[index], info)
        return observations, rewards, dones, infos

    def _end_episode(self, index: int, observations: np.ndarray, info: dict[str, Any], infos: dict[str, Any]) -> Any:
        """Put an ended episode's final observation into its info, and return the first one of the next episode."""
        raise NotImplementedError

    def close(self) -> None:
        """Close the environments."""
        self._env.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """
        Return None for each environment: SB3 asks for the mode of rendering.

        :param attr_name: the attribute's name
        :param indices: the environments; None for all
        :return: None for each of them
        """
        return [None for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """
        Refuse to set an attribute.

        :param attr_name: the attribute's name
        :param value: its value
        :param indices: the environments; None for all
        :raises NotImplementedError: always
        """
        raise NotImplementedError

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """
        Refuse to call a method.

        :param method_name: the method's name
        :param method_args: its arguments
        :param indices: the environments; None for all
        :param method_kwargs: its keyword arguments
        :raises NotImplementedError: always
        """
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """
        Return False for each environment: SB3 asks for ``Monitor``.

        :param wrapper_class: the wrapper
        :param indices: the environments; None for all
        :return: False for each of them
        """
        return [False for _ in self._get_indices(indices)]


class GymnasiumVecEnv(AdaptedVecEnv):
    """Gymnasium's vectorised environment, which resets an environment in the step that ends its episode."""

    def _end_episode(self, index: int, observations: np.ndarray, info: dict[str, Any], infos: dict[str, Any]) -> Any:
        info["terminal_observation"] = infos["final_obs"][index]
        return observations[index]


class EnvPoolVecEnv(AdaptedVecEnv):
    """EnvPool's environments, which are reset here, as EnvPool would replace the next step by the reset."""

    def _end_episode(self, index: int, observations: np.ndarray, info: dict[str, Any], infos: dict[str, Any]) -> Any:
        info["terminal_observation"] = observations[index].copy()
        return self._env.reset(np.array([index], dtype=np.int32))[0][0]


def make_gymnasium(env_id: str, n_envs: int, n_processes: int, seed: int, limits: bool = False) -> VecEnv:
    """
    Make Gymnasium's ``AsyncVectorEnv``: a process for each environment, which writes observations to shared memory.

    :param env_id: the environment
    :param n_envs: number of environments
    :param n_processes: number of environments that may step at the same time, if it is limited
    :param seed: the seed of the first one
    :param limits: whether it is limited
    :return: the environments
    """
    env = AsyncVectorEnv(
        [partial(gym.make, env_id)] * n_envs,
        # As the other ways: a forked process would share PyTorch's threads
        context="forkserver",
        autoreset_mode=AutoresetMode.SAME_STEP,
        max_concurrency=n_processes if limits else None,
    )
    return GymnasiumVecEnv(env, n_envs, (env.single_observation_space, env.single_action_space), seed)


def make_envpool(env_id: str, n_envs: int, n_processes: int, seed: int) -> VecEnv:
    """
    Make EnvPool's environments: threads in C++, with a MuJoCo of their own.

    :param env_id: the environment
    :param n_envs: number of environments
    :param n_processes: number of threads
    :param seed: the seed of the first one
    :return: the environments
    """
    env = importlib.import_module("envpool").make_gymnasium(env_id, num_envs=n_envs, num_threads=n_processes, seed=seed)
    return EnvPoolVecEnv(env, n_envs, (env.observation_space, env.action_space))


def _dummy(env_id: str, n_envs: int, n_processes: int, seed: int) -> VecEnv:
    return make_vec_env(env_id, n_envs, seed)


def _subproc(env_id: str, n_envs: int, n_processes: int, seed: int) -> VecEnv:
    return make_vec_env(env_id, n_envs, seed, vec_env_cls=SubprocVecEnv)


def _chunked(env_id: str, n_envs: int, n_processes: int, seed: int) -> VecEnv:
    return make_population_env(env_id, n_envs, n_processes, seed)


WAYS = {
    "dummy": Way("SB3's `DummyVecEnv`: one process", _dummy),
    "subproc": Way("SB3's `SubprocVecEnv`: a process per environment", _subproc),
    "gymnasium": Way("Gymnasium's `AsyncVectorEnv`: a process per environment, shared memory", make_gymnasium),
    "gymnasium-limited": Way("the same, as many at a time as cores", partial(make_gymnasium, limits=True)),
    "chunked": Way("`make_population_env`: a process per core", _chunked),
    "envpool": Way("EnvPool: a thread per core, in C++", make_envpool, "envpool"),
}
