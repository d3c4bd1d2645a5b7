"""Models of any spaces, to be exported, and their observations."""

from collections import OrderedDict
from pathlib import Path

import gymnasium as gym
import numpy as np
import onnxruntime
from gymnasium import spaces
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from torch import nn

from sb3_cgp import CGP

FILES = ("policy.onnx", "policy.safetensors", "policy.json")
VECTOR = spaces.Box(-np.inf, np.inf, (3,), np.float32)
ASYMMETRIC = spaces.Box(np.array([-1.0, 0.5, -30.0], np.float32), np.array([2.0, 0.75, 5.0], np.float32))


def by_key(function, *observations):
    """Apply a function to observations, or to those of each key."""
    if isinstance(observations[0], dict):
        return {key: function(*(each[key] for each in observations)) for key in observations[0]}
    return function(*observations)


class AnyEnv(gym.Env):
    """Random observations around a mean, whatever the spaces; goals too, for hindsight replay."""

    def __init__(self, observation_space, action_space, mean=0.0):
        self.observation_space, self.action_space, self.mean = observation_space, action_space, mean

    def _observe(self):
        return by_key(self._scale, self.observation_space.sample())

    def _scale(self, observation):
        return observation if observation.dtype == np.uint8 else (self.mean + 3.0 * observation).astype(observation.dtype)

    def compute_reward(self, achieved_goal, desired_goal, info):
        return np.zeros(len(np.atleast_2d(achieved_goal)), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self._observe(), {}

    def step(self, action):
        return self._observe(), 0.0, False, False, {}


def make_model(observation_space=VECTOR, action_space=ASYMMETRIC, normalize=None, policy="MlpPolicy", **kwargs):
    """A model whose actor and averaged actor differ, both with biases and actions well within the bounds."""
    # Far from zero, where float32 is coarse
    mean = 0.0 if normalize is None or normalize.keys() & {"norm_obs", "norm_obs_keys"} else 1000.0
    env = DummyVecEnv([lambda: AnyEnv(observation_space, action_space, mean)])
    if normalize is not None:
        env = VecNormalize(env, **normalize)
        env.reset()
        for _ in range(30):
            env.step(np.stack([action_space.sample()]))
    arguments = dict(buffer_size=10, seed=0, policy_kwargs=dict(net_arch=[16, 8]))
    model = CGP(policy, env, **(arguments | kwargs))
    for network in (model.actor, model.actor_target):
        for parameter in network.mu.parameters():
            nn.init.normal_(parameter, std=0.3)
    return model


def observations_of(model, n=7):
    (mean,) = model.get_env().get_attr("mean")
    env = AnyEnv(model.observation_space, model.action_space, mean)
    return by_key(lambda *each: np.stack(each), *(env._observe() for _ in range(n)))


def run_onnx(folder, observations):
    session = onnxruntime.InferenceSession(Path(folder) / "policy.onnx")
    inputs = observations if isinstance(observations, dict) else {"observation": observations}
    return session.run(["action"], inputs)[0]


IMAGE, IMAGE_FIRST = (spaces.Box(0, 255, shape, np.uint8) for shape in ((36, 40, 3), (3, 36, 40)))
DOUBLES = spaces.Box(-np.inf, np.inf, (2,), np.float64)
# In an order that is not the alphabet's, of the same shape, and with names that PyTorch gives to values of its graph
NAMES = OrderedDict((name, VECTOR) for name in ("view", "cat", "linear", "low", "mu_0", "input-0", "arm/joints:left"))
HER = dict(policy="MultiInputPolicy", replay_buffer_class=HerReplayBuffer)
GOALS = spaces.Dict(observation=spaces.Box(-np.inf, np.inf, (2, 2), np.float64), achieved_goal=DOUBLES, desired_goal=DOUBLES)


def make_goal_model():
    """A model of goals and images, of which the goals are normalised."""
    shapes = dict(observation=spaces.Box(-np.inf, np.inf, (3,), np.float64), achieved_goal=DOUBLES, desired_goal=DOUBLES)
    space = spaces.Dict(shapes | dict(image=IMAGE_FIRST))
    kwargs = dict(net_arch=[8], features_extractor_kwargs=dict(cnn_output_dim=4))
    return make_model(space, normalize=dict(norm_obs_keys=["observation", "achieved_goal"]), **HER, policy_kwargs=kwargs)
