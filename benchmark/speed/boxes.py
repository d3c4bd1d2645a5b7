"""An environment of any size that costs next to nothing, to see what an algorithm itself costs."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces


class BoxEnv(gym.Env[np.ndarray, np.ndarray]):
    """
    Random observations, no reward, and no end.

    :param observation_dim: the observations' size
    :param action_dim: the actions' size
    """

    def __init__(self, observation_dim: int, action_dim: int):
        self.observation_space = spaces.Box(-np.inf, np.inf, (observation_dim,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (action_dim,), np.float32)

    def _observe(self) -> np.ndarray:
        return self.np_random.standard_normal(self.observation_space.shape, np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """
        Begin the only episode.

        :param seed: seed of the observations
        :param options: of no influence
        :return: an observation, and nothing else to say
        """
        super().reset(seed=seed)
        return self._observe(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """
        Take a step.

        :param action: of no influence
        :return: an observation, no reward, no end, and nothing else to say
        """
        return self._observe(), 0.0, False, False, {}
