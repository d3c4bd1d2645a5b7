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

from sb3_cgp.common.rules import require
from sb3_cgp.export.boxes import ObservationSpace, boxes_of
from sb3_cgp.export.normalization import Normalizer


class ExportedNetwork(nn.Module):
    """
    The function from observations to actions, both in the environment's units.

    :param actor: the network that acts
    :param observation_space: the environment's observation space
    :param action_space: the environment's action space
    :param normalizers: the normalisation of observations by the names of the ONNX inputs; those without one are not normalised
    """

    low: th.Tensor
    high: th.Tensor

    def __init__(
        self,
        actor: Actor,
        observation_space: ObservationSpace,
        action_space: spaces.Box,
        normalizers: Mapping[str, Normalizer],
    ):
        super().__init__()
        self.actor = actor
        self.input_names = tuple(boxes_of(observation_space))
        self.has_keys = isinstance(observation_space, spaces.Dict)
        self.action_shape = action_space.shape
        self.register_buffer("low", th.as_tensor(action_space.low))
        self.register_buffer("high", th.as_tensor(action_space.high))
        self.normalizers = nn.ModuleList(normalizers.get(name, nn.Identity()) for name in self.input_names)

    def forward(self, *observations: th.Tensor) -> th.Tensor:
        """
        Return the actions for observations.

        :param observations: a batch of B observations; of a Dict space one batch for each key, in the space's order
        :return: the actions, (B, *action_space.shape), within the action space's bounds and in its data type
        """
        boxes = [normalizer(each) for normalizer, each in zip(self.normalizers, observations, strict=True)]
        scaled = self.actor(dict(zip(self.input_names, boxes, strict=True)) if self.has_keys else boxes[0])
        scaled = scaled.reshape(-1, *self.action_shape)
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
        observation_space: ObservationSpace,
        action_space: spaces.Box,
        description: Mapping[str, Any],
    ):
        self.network = network
        self.observation_space = observation_space
        self.action_space = action_space
        self.description = description
        self._boxes = boxes_of(observation_space)

    def predict(
        self,
        observation: np.ndarray | Mapping[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        Return the policy's action, as SB3's ``predict`` does.

        :param observation: one observation, of the observation space's shape, or a batch of B of them; not normalised.
            Images may be channels last. Of a Dict space one array for each key.
        :param state: returned unchanged, as the policy is not recurrent
        :param episode_start: ignored
        :param deterministic: ignored, as the actor is deterministic
        :return: the action, of the action space's shape, or B of them; and the state
        :raises ValueError: if the observation has another shape or other keys, or is a batch for some keys alone
        """
        batches, is_batch = self._batches(observation)
        with th.no_grad():
            actions = self.network(*map(th.as_tensor, batches)).numpy()
        return (actions if is_batch else actions[0]), state

    def _batches(self, observation: np.ndarray | Mapping[str, np.ndarray]) -> tuple[list[np.ndarray], bool]:
        """Return a batch for each box, and whether the observation is a batch."""
        if isinstance(observation, Mapping) != self.network.has_keys:
            allowed = f"a dictionary of the keys {', '.join(self._boxes)}" if self.network.has_keys else "an array"
            require(False, "observation", observation, f"{allowed}, as in {self.observation_space}")
        if not isinstance(observation, Mapping):
            (box,) = self._boxes.values()
            batch, is_batch = _batch(observation, box)
            return [batch], is_batch
        has_keys = observation.keys() == self._boxes.keys()
        require(has_keys, "observation", list(observation), f"a dictionary of exactly the keys {', '.join(self._boxes)}")
        pairs = [_batch(observation[key], box) for key, box in self._boxes.items()]
        is_same = len({(len(batch), is_batch) for batch, is_batch in pairs}) == 1
        shapes = {key: np.shape(value) for key, value in observation.items()}
        require(is_same, "observation", shapes, "one observation for every key, or batches of one length")
        return [batch for batch, _ in pairs], pairs[0][1]


def _batch(observation: np.ndarray, box: spaces.Box) -> tuple[np.ndarray, bool]:
    """Return observations of one box as a batch in contiguous memory, and whether they were given as a batch."""
    observation = maybe_transpose(np.asarray(observation), box)
    is_batch = is_vectorized_observation(observation, box)
    return np.ascontiguousarray(observation.reshape(-1, *box.shape)), is_batch
