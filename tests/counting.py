"""An environment that counts its steps, and arguments of small models, for the tests of the bias of values."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces

GAMMA = 0.99
SMALL = dict(learning_starts=20, batch_size=8, buffer_size=200, policy_kwargs=dict(net_arch=[8, 8]), seed=0)


class Counter(gym.Env):
    """Observes the number of steps so far, rewards each with 1, and terminates after some, or never."""

    observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = spaces.Box(-2.0, 2.0, (1,), np.float32)

    def __init__(self, ends_after=None):
        self.ends_after = ends_after

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self.observe(), {}

    def observe(self):
        return np.array([self.steps], np.float32)

    def step(self, action):
        self.steps += 1
        return self.observe(), 1.0, self.steps == self.ends_after, False, {}
