"""
What is checked of a transition before it is stored: the checks, their list (:func:`make_checks`), and when they are made.

To add a check, write a function of a :class:`Transition` here, and add it to the list.
"""

import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs

from sb3_cgp.common.spaces import by_key
from sb3_cgp.guards.explanations import check_reset_info
from sb3_cgp.guards.observation_fit import check_integers, check_shape, wrong_shape
from sb3_cgp.guards.observations import innermost

LARGEST_FLOAT32 = np.finfo(np.float32).max


class Transition(NamedTuple):
    """
    One step of all N environments, as they returned it, before ``VecNormalize``.

    :param timestep: the environment step, counted over all environments
    :param observation_space: the observation space
    :param observations: the new observations, (N, *shape), by key for ``Dict`` spaces
    :param rewards: the rewards, (N,); None for the first observations of a training
    :param final_observations: the last observation, (*shape), of each environment whose episode ended
    :param n_envs: N
    """

    timestep: int
    observation_space: spaces.Space
    observations: VecEnvObs
    rewards: Any
    final_observations: list[Any]
    n_envs: int


Check = Callable[[Transition], None]


def make_checks(observation_space: spaces.Space) -> list[Check]:
    """
    Return the checks of a training's transitions, in their order.

    Each raises a ``ValueError`` that names the value and the step, or warns. None may change the transition.

    :param observation_space: the space of the observations before their normalisation, for the warning about bounds
    :return: the checks
    """
    return [
        check_rewards,
        check_observation_fit,
        check_finite_values,
        BoundsWatch(observation_space),
        check_final_observations,
    ]


def check_rewards(transition: Transition) -> None:
    """
    Refuse rewards that are not one number for each environment.

    :param transition: the transition
    :raises ValueError: naming the shape and the one that is expected, or the rewards
    """
    rewards, timestep = transition.rewards, transition.timestep
    if rewards is None:
        return
    if np.shape(rewards) != (transition.n_envs,):
        raise wrong_shape("reward", np.shape(rewards), (transition.n_envs,), timestep)
    if np.asarray(rewards).dtype.kind not in "biuf":
        raise ValueError(f"The environment returned a reward that is not a number at environment step {timestep}: {rewards}.")


def check_observation_fit(transition: Transition) -> None:
    """
    Refuse observations that do not fit their space.

    :param transition: the transition
    :raises ValueError: naming the key, the shape or the value, and what is expected
    """
    observations, space, timestep = transition.observations, transition.observation_space, transition.timestep
    check_shape("observation", observations, space, transition.n_envs, timestep)
    check_integers("observation", observations, space, timestep)


def check_finite_values(transition: Transition) -> None:
    """
    Refuse rewards and observations that are NaN or infinite.

    :param transition: the transition
    :raises ValueError: naming the values
    """
    if transition.rewards is not None:
        check_finite("reward", transition.rewards, transition.timestep)
    check_finite("observation", _stored(transition.observations, transition.observation_space), transition.timestep)


def check_final_observations(transition: Transition) -> None:
    """
    Refuse final observations of a wrong shape, or that are NaN or infinite. `VecNormalize` may have normalised them.

    :param transition: the transition
    :raises ValueError: naming what is wrong
    """
    for observation in transition.final_observations:
        check_final_observation(observation, transition.observation_space, transition.timestep)


class BoundsWatch:
    """
    Warn of the first observation that is outside of its space. Nothing in CGP depends on these bounds.

    :param space: the observation space
    """

    def __init__(self, space: spaces.Space):
        # Integers, such as images, cannot leave the bounds of their type
        self._boxes = {
            key: box
            for key, box in by_key(space).items()
            if isinstance(box, spaces.Box)
            and np.issubdtype(box.dtype, np.floating)
            and (box.bounded_below.any() or box.bounded_above.any())
        }

    def __call__(self, transition: Transition) -> None:
        """
        Warn if an observation of a transition is out of bounds, unless that has happened before.

        :param transition: the transition
        """
        for key, box in self._boxes.items():
            # In the data type of the space, as its bounds
            values = np.asarray(by_key(transition.observations)[key], box.dtype)
            outside = (values < box.low) | (values > box.high)
            if outside.any():
                self._warn(key, box, values, outside, transition.timestep)
                self._boxes = {}
                return

    @staticmethod
    def _warn(key: str | None, box: spaces.Box, values: np.ndarray, outside: np.ndarray, timestep: int) -> None:
        first = tuple(np.argwhere(outside)[0].tolist())
        # Observations of several environments have an axis more
        index = first[values.ndim - len(box.shape) :]
        name = "observation" if key is None else f"observation `{key}`"
        warnings.warn(
            f"The environment returned an {name} outside of its observation space at environment step {timestep}: value "
            f"{values[first]} at index {index}, where the bounds are [{box.low[index]}, {box.high[index]}]. Training goes on, "
            "as nothing in the algorithm depends on these bounds. This is said once.",
            stacklevel=2,
        )


def check_finite(name: str, values: Any, timestep: int) -> None:
    """
    Refuse values that are NaN or infinite in float32.

    :param name: the name of the values, for the error
    :param values: an array, or arrays by key
    :param timestep: the environment step
    :raises ValueError: if a value is NaN or infinite
    """
    for key, array in by_key(values).items():
        # False for NaN, too
        if not (np.abs(array) <= LARGEST_FLOAT32).all():
            which = name if key is None else f"{name} `{key}`"
            raise ValueError(
                f"The environment returned a NaN or infinite (in float32) {which} at environment step {timestep}: {array}. "
                "It was not stored, and the networks are as before it."
            )


def check_final_observation(observation: Any, space: spaces.Space, timestep: int) -> None:
    """
    Refuse an episode's last observation if it is of a wrong shape, NaN or infinite.

    :param observation: the observation of one environment
    :param space: the observation space
    :param timestep: the environment step
    :raises ValueError: naming what is wrong
    """
    check_shape("terminal observation", observation, space, None, timestep)
    check_finite("terminal observation", _stored(observation, space), timestep)


def _stored(observation: Any, space: spaces.Space) -> dict[Any, Any]:
    """Return the parts of an observation that its space has: further keys of a ``Dict`` may hold anything."""
    return {key: observation if key is None else observation[key] for key in by_key(space)}


class TransitionGuard(OffPolicyAlgorithm):
    """An algorithm that makes the checks of :func:`make_checks` before it stores a transition."""

    # Made anew for each training, as some warn once
    _checks: list[Check]

    def _begin_checks(self) -> None:
        """Make the checks of a training, and check its first observations."""
        # VecNormalize's own space has the bounds of normalised observations, which are not checked
        normalizer = self._vec_normalize_env
        self._checks = make_checks(self.observation_space if normalizer is None else normalizer.venv.observation_space)
        self._check_first_observations()

    def _check_first_observations(self) -> None:
        """Check the observations that an episode starts with."""
        assert self.env is not None
        observations = self._last_obs if self._vec_normalize_env is None else self._last_original_obs
        assert observations is not None
        bare = innermost(self.env)
        # Environments of other packages may keep no infos
        if isinstance(bare, DummyVecEnv | SubprocVecEnv):
            for info in bare.reset_infos:
                check_reset_info(info)
        self._check(Transition(self.num_timesteps, self.observation_space, observations, None, [], self.n_envs))

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        # Clipping by VecNormalize would hide an infinite value
        normalizer = self._vec_normalize_env
        rewards = reward if normalizer is None else normalizer.get_original_reward()
        observations = new_obs if normalizer is None else normalizer.get_original_obs()
        ended = [info for info, done in zip(infos, dones, strict=True) if done]
        final = [info["terminal_observation"] for info in ended if info.get("terminal_observation") is not None]
        self._check(Transition(self.num_timesteps, self.observation_space, observations, rewards, final, self.n_envs))
        if normalizer is None:
            for observation in final:
                check_integers("terminal observation", observation, self.observation_space, self.num_timesteps)
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)

    def _check(self, transition: Transition) -> None:
        for check in self._checks:
            check(transition)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_checks"]
