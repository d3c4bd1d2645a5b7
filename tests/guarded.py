"""SB3's TD3 with all guards, and environments that say where they are, for the tests of the guards."""

import itertools

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3 import TD3
from stable_baselines3.common.vec_env import DummyVecEnv
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_cgp import CGP
from sb3_cgp.guards import GuardedAlgorithm

SMALL = dict(learning_starts=6, batch_size=8, buffer_size=1000, policy_kwargs=dict(net_arch=[4]), seed=0, device="cpu")

ACTIONS = spaces.Box(-1, 1, (1,), np.float32)

BUFFERS = {
    "plain": dict(),
    "n-step": dict(n_steps=3),
    "memory-efficient": dict(optimize_memory_usage=True, replay_buffer_kwargs=dict(handle_timeout_termination=False)),
    "hindsight": dict(replay_buffer_class=HerReplayBuffer, learning_starts=16),
}

# SB3 and the guards warn of trainings as short as those of the tests
IGNORED_WARNINGS = [
    pytest.mark.filterwarnings("ignore:The last trajectory in the replay buffer will be truncated"),
    pytest.mark.filterwarnings("ignore:Nothing is learnt"),
    pytest.mark.filterwarnings("ignore:Evaluation environment is not wrapped"),
]


def make(policy="MlpPolicy", env="Pendulum-v1", algorithm=CGP, **arguments):
    """A small model, of CGP unless said otherwise."""
    return algorithm(policy, env, **SMALL | arguments)


class GuardedTD3(GuardedAlgorithm, TD3):
    """Knows nothing of CGP's."""


class Located(gym.Env):
    """
    Observes the number of its episode, which no other episode has, and of its step. Each step has reward 1.

    :param length: steps of an episode, which then runs out of time
    :param goals: whether the observation is a Dict with goals, as for hindsight replay
    """

    numbers = itertools.count(1)
    action_space = ACTIONS

    def __init__(self, length=7, goals=False):
        self.length, self.goals = length, goals
        box = spaces.Box(-np.inf, np.inf, (2,), np.float32)
        keys = ("observation", "achieved_goal", "desired_goal")
        self.observation_space = spaces.Dict(dict.fromkeys(keys, box)) if goals else box

    def observe(self):
        here = np.array([self.episode, self.steps], np.float32)
        goal = np.array([self.episode, -1], np.float32)
        return dict(observation=here, achieved_goal=here.copy(), desired_goal=goal) if self.goals else here

    def reset(self, *, seed=None, options=None):
        self.episode, self.steps = next(self.numbers), 0
        return self.observe(), {}

    def step(self, action):
        self.steps += 1
        return self.observe(), 1.0, False, self.steps >= self.length, {}

    def compute_reward(self, achieved_goal, desired_goal, info):
        return np.ones(len(achieved_goal), np.float32)


def located(n_envs=1, **kwargs):
    return DummyVecEnv([lambda: Located(**kwargs)] * n_envs)


def make_model(kind, n_envs=1, env=None, **kwargs):
    """Make a model with a replay buffer of a kind of :data:`BUFFERS`."""
    goals = kind == "hindsight"
    policy = "MultiInputPolicy" if goals else "MlpPolicy"
    return GuardedTD3(policy, located(n_envs, goals=goals) if env is None else env, **(SMALL | BUFFERS[kind] | kwargs))


def assert_no_episode_runs_into_another(buffer, n_steps=1, gamma=0.99):
    """Each sampled transition was made, within one episode, and its return is that of its own steps."""
    batch = buffer.sample(600)
    goals = isinstance(batch.observations, dict)
    start, end = (
        (values["observation"] if goals else values).numpy() for values in (batch.observations, batch.next_observations)
    )
    # The memory-efficient buffer has no next observation where an episode ends
    known = batch.dones.numpy()[:, 0] == 0
    assert known.mean() > 0.5
    length = (end - start)[known, 1]
    np.testing.assert_array_equal(start[known, 0], end[known, 0])
    assert np.all((length >= 1) & (length <= n_steps))
    expected = np.array([sum(gamma**k for k in range(int(each))) for each in length])
    np.testing.assert_allclose(batch.rewards.numpy()[known, 0], expected, rtol=1e-5)
    if n_steps > 1:
        assert np.any(length == n_steps)
        np.testing.assert_allclose(batch.discounts.numpy()[known, 0], gamma**length, rtol=1e-5)
    if goals:
        goal = batch.observations["desired_goal"].numpy()
        np.testing.assert_array_equal(goal[:, 0], start[:, 0])
        hindsight = goal[:, 1] >= 0
        assert hindsight.any()
        assert np.all(goal[hindsight, 1] > start[hindsight, 1])
