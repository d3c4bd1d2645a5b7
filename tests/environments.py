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


class Reach(gym.Env):
    """Move to a goal on a line; it takes part in the protocol for environments of one's own."""

    place, goal, steps = 0.0, 0.0, 0
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
    observation_space = spaces.Dict(
        {key: spaces.Box(-9, 9, (1,), np.float32) for key in ("observation", "achieved_goal", "desired_goal")}
    )

    def observe(self):
        place = np.array([self.place], np.float32)
        return {"observation": place, "achieved_goal": place, "desired_goal": np.array([self.goal], np.float32)}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.goal, self.steps = 0.0, float(self.np_random.uniform(-2, 2)), 0
        return self.observe(), {}

    def step(self, action):
        self.place, self.steps = float(np.clip(self.place + action[0], -9, 9)), self.steps + 1
        observation = self.observe()
        reward = float(self.compute_reward(observation["achieved_goal"], observation["desired_goal"], {})[0])
        return observation, reward, bool(reward == 0.0), self.steps >= 12, {}

    def compute_reward(self, achieved, desired, info):
        return -(np.abs(achieved - desired) > 0.3).astype(np.float32).reshape(len(np.atleast_2d(achieved)))

    def get_training_state(self):
        return {"place": self.place, "goal": self.goal, "steps": self.steps, "random": self.np_random.bit_generator.state}

    def set_training_state(self, state):
        self.place, self.goal, self.steps = state["place"], state["goal"], state["steps"]
        self.np_random.bit_generator.state = state["random"]
