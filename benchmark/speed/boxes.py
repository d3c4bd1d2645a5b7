"""An environment of any size whose steps take almost no time, to measure the time of an algorithm alone."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces


class BoxEnv(gym.Env[np.ndarray, np.ndarray]):
    """
    An environment with random observations, no reward, and no end of an episode.

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
        :param options: ignored
        :return: an observation, and an empty dictionary
        """
        super().reset(seed=seed)
        return self._observe(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """
        Take a step.

        :param action: ignored
        :return: an observation, a reward of 0, False twice, and an empty dictionary
        """
        return self._observe(), 0.0, False, False, {}
