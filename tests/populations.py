"""Small populations of agents, whose environments and arguments differ, and comparisons of agents."""

import numpy as np
import torch as th
from environments import Doubles
from gymnasium import spaces
from stable_baselines3.common.logger import KVWriter
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv
from torch import nn

from sb3_cgp.population import Population
from sb3_cgp.selectors import MPPI, ActorCEM, ActorOnly, ActorStart

SMALL = dict(
    learning_starts=20, buffer_size=500, batch_size=8, cem_samples=6, cem_elites=2, cem_dtype="float32", seed=0, device="cpu"
)
# Agents that differ in everything that they may
AGENTS = [
    dict(),
    dict(
        seed=7, learning_rate=3e-3, tau=0.05, gamma=0.9, target_policy_noise=0.5, target_noise_clip=0.1, policy_delay=3,
        target_update_interval=1, learning_starts=22, action_noise=NormalActionNoise(np.zeros(2), 0.3 * np.ones(2)),
    ),
    dict(
        learning_rate="lin_1e-2", actor_learning_rate=2e-4, gamma=0.5, tau=1.0, target_policy_noise=0.0, policy_delay=1,
        target_update_interval=5,
    ),
]  # fmt: skip
TD3 = dict(policy_loss="qgp", policy_delay=2)
VARIANTS = {
    "CGP": dict(),
    "QGP": dict(policy_loss="qgp"),
    "CEM": dict(policy_loss=None),
    "CGP, offline": dict(policy_training="offline"),
    "mean of the elites": dict(cem_result="mean", cem_iterations=3),
    "CGP-Light": dict(cem_start="actor", cem_iterations=1),
    "from the actor, offline": dict(cem_start="actor", policy_training="offline"),
    "MPPI": dict(policy_kwargs=dict(selector=MPPI(2, 6, 3))),
    "MPPI from the actor": dict(policy_kwargs=dict(selector=MPPI(2, 6, 3, start=ActorStart()))),
    "ActorCEM": dict(policy_kwargs=dict(selector=ActorCEM(2, 8, 3))),
    "TD3": dict(**TD3, policy_kwargs=dict(selector=ActorOnly())),
    "DDPG": dict(**TD3, policy_kwargs=dict(selector=ActorOnly(), n_critics=1)),
    "n-step": dict(n_steps=3),
    "networks": dict(policy_kwargs=dict(net_arch=dict(pi=[6], qf=[9, 5, 7]), activation_fn=nn.Tanh, n_critics=3)),
}


class Pushed(Doubles):
    """Rewards depend on the observation, and every second episode ends by a termination."""

    episode = 0

    def ends_by_timeout(self):
        self.episode += 1
        return self.episode % 2 == 0

    def step(self, action):
        observation, _, *rest = super().step(action)
        return observation, float(action @ observation[:2]), *rest


class PushedOnAxes(Pushed):
    """The same, with actions and observations of several axes."""

    observation_space = spaces.Box(-np.inf, np.inf, (3, 2), np.float64)
    action_space = spaces.Box(-np.ones((2, 2), np.float32), 3.0, (2, 2), np.float32)

    def observe(self):
        return self.np_random.normal(size=(3, 2))

    def step(self, action):
        observation, _, *rest = Doubles.step(self, action)
        return observation, float((action * observation[:2]).sum()), *rest


def make_env(n_envs=3, env=Pushed):
    return DummyVecEnv([env] * n_envs)


def make(agents=3, env=None, **kwargs):
    arguments = SMALL | kwargs
    arguments["policy_kwargs"] = dict(net_arch=[8, 8]) | arguments.get("policy_kwargs", {})
    n_agents = agents if isinstance(agents, int) else len(agents)
    return Population("MlpPolicy", make_env(n_agents) if env is None else env, agents, **arguments)


def adam_state(model, name):
    optimizer = getattr(model, name).optimizer
    return [optimizer.state[parameter] for group in optimizer.param_groups for parameter in group["params"]]


def assert_alike(agent, alone, **tolerance):
    """Compare networks, averages, and the optimizers' moments and step counts."""
    for name, value in alone.policy.state_dict().items():
        th.testing.assert_close(agent.policy.state_dict()[name], value, msg=name, **tolerance)
    for name in ("actor", "critic"):
        for own, expected in zip(adam_state(agent, name), adam_state(alone, name), strict=True):
            assert own.keys() == expected.keys()
            for key, value in expected.items():
                th.testing.assert_close(own[key], value, msg=key, check_dtype=False, **tolerance)
    assert agent._n_updates == alone._n_updates


def saved_and_loaded(population, folder):
    """Save a population of three and its transitions, and return what is loaded from the files."""
    population.save(folder / "population")
    population.save_replay_buffer(folder / "buffer")
    loaded = Population.load(folder / "population", env=make_env())
    loaded.load_replay_buffer(folder / "buffer")
    return loaded


class Log(KVWriter):
    """Keeps what is logged."""

    def __init__(self):
        self.rows = []

    def write(self, key_values, key_excluded, step=0):
        self.rows.append({**key_values, "step": step})

    def close(self):
        pass
