"""The methods of the run-time table, all with the same batch size, network and schedule."""

import importlib
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from benchmark.common.settings import LIGHT_ARGUMENTS
from sb3_cgp.core.policies import CGPPolicy as PlainPolicy

BATCH_SIZE = 128
NET_ARCH = [256, 256]
# Enough for the measured steps: a larger buffer takes time with allocators that write all of it
BUFFER_SIZE = 100_000
REFERENCE = "TD3"


class RandomAgent:
    """
    Acts at random, with the interface of SB3's models.

    :param env: the environment to act in
    """

    def __init__(self, env: VecEnv):
        self.action_space, self.n_envs = env.action_space, env.num_envs

    def predict(self, observation: np.ndarray, deterministic: bool = False) -> tuple[np.ndarray, None]:
        """
        Draw an action for each environment.

        :param observation: ignored
        :param deterministic: ignored
        :return: the actions, and no recurrent state
        """
        return np.array([self.action_space.sample() for _ in range(self.n_envs)]), None


@dataclass(frozen=True)
class Contender:
    """
    A method to measure.

    :param package: the package of its algorithm; None for random actions
    :param algorithm: the algorithm's name there
    :param paper_train: the paper's training time, as a ratio to TD3's; None where it has none
    :param paper_inference: the paper's inference time, as a ratio to TD3's; None where it has none
    :param kwargs: the algorithm's arguments besides the common ones
    :param policy: the policy
    """

    package: str | None
    algorithm: str = ""
    paper_train: float | None = None
    paper_inference: float | None = None
    kwargs: dict[str, Any] = field(default_factory=dict)
    policy: str | type = "MlpPolicy"


CONTENDERS = {
    "Random": Contender(None, paper_inference=0.20),
    "DDPG": Contender("stable_baselines3", "DDPG", 1.01, 0.99),
    "TD3": Contender("stable_baselines3", "TD3", 1.0, 1.0),
    "SAC": Contender("stable_baselines3", "SAC", 1.94, 1.0),
    "CEM-2": Contender("sb3_cgp", "CGP", 1.25, 2.68, dict(policy_loss=None, cem_iterations=2)),
    "CEM-4": Contender("sb3_cgp", "CGP", 1.64, 4.30, dict(policy_loss=None, cem_iterations=4)),
    "CGP-2": Contender("sb3_cgp", "CGP", 1.95, 1.0, dict(cem_iterations=2)),
    "CGP-4": Contender("sb3_cgp", "CGP", 2.55, 1.0, dict(cem_iterations=4)),
    "CGP-Light": Contender("sb3_cgp", "CGP", kwargs=LIGHT_ARGUMENTS),
    # The actor is updated as seldom as TD3's
    "CGP-Light-delayed": Contender("sb3_cgp", "CGP", kwargs=LIGHT_ARGUMENTS | dict(policy_delay=2)),
    "CGP-2-plain": Contender("sb3_cgp", "CGP", kwargs=dict(cem_iterations=2), policy=PlainPolicy),
    "TQC": Contender("sb3_contrib", "TQC"),
    "CrossQ": Contender("sb3_contrib", "CrossQ"),
    "SBX-TD3": Contender("sbx", "TD3"),
}


def takes_cem_dtype(name: str) -> bool:
    """
    Return whether a method has the argument ``cem_dtype``.

    :param name: the method
    :return: whether it is CGP with its own scoring
    """
    return CONTENDERS[name].algorithm == "CGP" and CONTENDERS[name].policy is not PlainPolicy


def make_agent(
    name: str, env: VecEnv, learning_starts: int, seed: int, device: th.device, **kwargs: Any
) -> OffPolicyAlgorithm | RandomAgent:
    """
    Return the untrained model of a method.

    :param name: the method
    :param env: the environment to train in
    :param learning_starts: random steps before the first gradient step
    :param seed: seed of its random numbers
    :param device: device of its networks
    :param kwargs: further arguments of the algorithm
    :return: the model
    :raises ImportError: if the algorithm's package is not installed
    """
    contender = CONTENDERS[name]
    if contender.package is None:
        assert isinstance(env.action_space, spaces.Box)
        env.action_space.seed(seed)
        return RandomAgent(env)
    package = importlib.import_module(contender.package)
    algorithm: type[OffPolicyAlgorithm] = getattr(package, contender.algorithm)
    arguments: dict[str, Any] = dict(
        buffer_size=BUFFER_SIZE,
        learning_starts=learning_starts,
        batch_size=BATCH_SIZE,
        train_freq=1,
        gradient_steps=1,
        policy_kwargs=dict(net_arch=NET_ARCH.copy()),
        seed=seed,
        device=str(device),
    )
    return algorithm(contender.policy, env, **arguments, **contender.kwargs, **kwargs)
