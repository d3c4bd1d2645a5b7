"""The methods whose critics are compared, all with the same batch size, networks, learning rate and random steps."""

from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import TD3
from stable_baselines3.common.noise import NormalActionNoise

from benchmark.common.settings import LIGHT_ARGUMENTS
from benchmark.values.variants import ClampedCGP, FlooredCGP, MinScorePolicy
from sb3_cgp import CGP, CGPPolicy

LEARNING_RATE = 1e-3
# Of TD3, as its authors have it; CGP explores by CEM's own sampling
EXPLORATION_NOISE = 0.1


@dataclass(frozen=True)
class Method:
    """
    A method to measure.

    :param algorithm: the algorithm
    :param kwargs: its arguments besides the common ones
    :param policy: the policy
    """

    algorithm: type[CGP] | type[TD3] = CGP
    kwargs: dict[str, Any] = field(default_factory=dict)
    policy: str | type[CGPPolicy] = "MlpPolicy"


MAIN = {
    **{f"CGP-{iterations}": Method(kwargs=dict(cem_iterations=iterations)) for iterations in (1, 2, 4, 8)},
    "CGP-Light": Method(kwargs=LIGHT_ARGUMENTS),
    "TD3": Method(TD3),
}
# CGP-2 with one change each. A CUDA graph would fix the range of ClampedCGP.
VARIANTS = {
    "CGP-2-floor": Method(FlooredCGP, dict(cem_iterations=2)),
    "CGP-2-clamp": Method(ClampedCGP, dict(cem_iterations=2, cuda_graphs=False)),
    "CGP-2-min": Method(kwargs=dict(cem_iterations=2), policy=MinScorePolicy),
    "CGP-2-mean": Method(kwargs=dict(cem_iterations=2, cem_result="mean")),
}
METHODS = MAIN | VARIANTS


def make_model(name: str, env_id: str, units: int, seed: int, device: th.device, **kwargs: Any) -> CGP | TD3:
    """
    Return the untrained model of a method.

    :param name: the method
    :param env_id: the environment
    :param units: units of each of the two hidden layers of all networks
    :param seed: seed of its random numbers
    :param device: device of its networks
    :param kwargs: further arguments of the algorithm
    :return: the model
    """
    method = METHODS[name]
    kwargs = kwargs | method.kwargs
    if method.algorithm is TD3:
        kwargs["action_noise"] = _exploration_noise(env_id)
    kwargs |= dict(learning_rate=LEARNING_RATE, policy_kwargs=dict(net_arch=[units, units]), seed=seed, device=str(device))
    return method.algorithm(method.policy, env_id, **kwargs)


def _exploration_noise(env_id: str) -> NormalActionNoise:
    """Return Gaussian noise of SB3's scaled actions."""
    env = gym.make(env_id)
    env.close()
    assert isinstance(env.action_space, spaces.Box)
    shape = env.action_space.shape
    return NormalActionNoise(np.zeros(shape), np.full(shape, EXPLORATION_NOISE))
