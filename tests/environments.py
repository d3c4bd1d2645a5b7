"""Environments that several tests share."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces


class Doubles(gym.Env):
    """Random float64 observations, five steps an episode, which ends by a timeout."""

    observation_space = spaces.Box(-np.inf, np.inf, (3,), np.float64)
    action_space = spaces.Box(-1, 1, (2,), np.float32)

    def observe(self):
        return self.np_random.normal(size=3)

    def ends_by_timeout(self):
        return True

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self.observe(), {}

    def step(self, action):
        self.steps += 1
        ends, is_timeout = self.steps == 5, self.ends_by_timeout()
        return self.observe(), float(action.sum()), ends and not is_timeout, ends and is_timeout, {}
