"""The methods of the measurements of a population, and the populations that they make."""

from functools import partial
from typing import Any

import torch as th
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv

from benchmark.speed.boxes import BoxEnv
from benchmark.speed.contenders import BATCH_SIZE, CONTENDERS, NET_ARCH
from sb3_cgp.population import Population
from sb3_cgp.selectors import ActorOnly

TD3: dict[str, Any] = dict(policy_loss="qgp", policy_delay=2)
# The paper's CEM, the light setting, and the selector that is the actor alone
METHODS: tuple[str, ...] = ("CGP-2", "CGP-Light", "TD3")
# Dimensions of observations and of actions
Dimensions = tuple[int, int]
HALF_CHEETAH: Dimensions = (17, 6)


def make_population(method: str, env: VecEnv, device: th.device | str, seed: int = 0, **arguments: Any) -> Population:
    """
    Make the population of a method, of an agent for each environment.

    :param method: one of :data:`METHODS`, or another CGP of the run-time table
    :param env: the environments
    :param device: device of the networks
    :param seed: the first agent's seed
    :param arguments: further arguments of all agents
    :return: the population
    """
    policy_kwargs: dict[str, Any] = dict(net_arch=NET_ARCH.copy())
    own = CONTENDERS[method].kwargs
    if method == "TD3":
        policy_kwargs["selector"] = ActorOnly()
        own = TD3
    common: dict[str, Any] = dict(batch_size=BATCH_SIZE, train_freq=1, gradient_steps=1, policy_kwargs=policy_kwargs)
    return Population("MlpPolicy", env, env.num_envs, device=device, seed=seed, **common, **own, **arguments)


def make_box(dimensions: Dimensions = HALF_CHEETAH) -> VecEnv:
    """
    Make an environment whose steps take almost no time.

    :param dimensions: of observations and of actions
    :return: the environment
    """
    return make_vec_env(partial(BoxEnv, *dimensions))
