"""A policy that was exported: its network, and ``predict`` as SB3's models have it."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import maybe_transpose
from stable_baselines3.common.utils import is_vectorized_observation
from stable_baselines3.td3.policies import Actor
from torch import nn


class ExportedNetwork(nn.Module):
    """
    The function from observations to actions, both in the environment's units.

    :param actor: the network that acts
    :param action_space: the environment's action space
    :param normalization: the mean and the variance of the observations, of their shape and in float64, the constant added to
        the variance, and the bound for clipping (infinite for none); None for observations that are not normalised
    """

    low: th.Tensor
    high: th.Tensor
    mean: th.Tensor
    deviation: th.Tensor

    def __init__(
        self, actor: Actor, action_space: spaces.Box, normalization: tuple[th.Tensor, th.Tensor, float, float] | None
    ):
        super().__init__()
        self.actor = actor
        self.action_shape = action_space.shape
        self.register_buffer("low", th.as_tensor(action_space.low))
        self.register_buffer("high", th.as_tensor(action_space.high))
        self.is_normalized = normalization is not None
        if normalization is not None:
            mean, variance, epsilon, self.clip_obs = normalization
            self.register_buffer("mean", mean)
            self.register_buffer("deviation", (variance + epsilon).sqrt())

    def forward(self, observation: th.Tensor) -> th.Tensor:
        """
        Return the actions for observations.

        :param observation: a batch of B observations
        :return: the actions, (B, *action_space.shape), within the action space's bounds and in its data type
        """
        if self.is_normalized:
            # In float64, as VecNormalize computes
            deviations = (observation.double() - self.mean) / self.deviation
            observation = deviations.clamp(-self.clip_obs, self.clip_obs).float()
        scaled = self.actor(observation).reshape(-1, *self.action_shape)
        low, high = self.low, self.high
        actions = low + (0.5 * (scaled.to(low.dtype) + 1.0) * (high - low))
        # Rounding can put the sum beyond a bound by one unit in the last place
        return th.minimum(th.maximum(actions, low), high)


class ExportedPolicy:
    """
    A policy that acts on the CPU, and cannot be trained.

    :param network: the function from observations to actions
    :param observation_space: the environment's observation space, images channels first
    :param action_space: the environment's action space
    :param description: the content of ``policy.json``
    """

    def __init__(
        self,
        network: ExportedNetwork,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        description: Mapping[str, Any],
    ):
        self.network = network
        self.observation_space = observation_space
        self.action_space = action_space
        self.description = description

    def predict(
        self,
        observation: np.ndarray,
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        Return the policy's action, as SB3's ``predict`` does.

        :param observation: one observation, of the observation space's shape, or a batch of B of them; not normalised.
            Images may be channels last.
        :param state: returned unchanged, as the policy is not recurrent
        :param episode_start: ignored
        :param deterministic: ignored, as the actor is deterministic
        :return: the action, of the action space's shape, or B of them; and the state
        :raises ValueError: if the observation has another shape
        """
        observation = maybe_transpose(np.asarray(observation), self.observation_space)
        is_batch = is_vectorized_observation(observation, self.observation_space)
        batch = np.ascontiguousarray(observation.reshape(-1, *self.observation_space.shape))
        with th.no_grad():
            actions = self.network(th.as_tensor(batch)).numpy()
        return (actions if is_batch else actions[0]), state
