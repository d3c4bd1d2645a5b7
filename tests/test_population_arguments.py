"""Arguments of a population: those that are not possible are refused by name, and a selector is taken as it is."""

import numpy as np
import pytest
import torch as th
from populations import make, make_env
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise, VectorizedActionNoise
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from sb3_cgp import CEM, CGPPolicy
from sb3_cgp.core.losses import POLICY_LOSSES
from sb3_cgp.population import Population, evaluate_population

NOISE = NormalActionNoise(np.zeros(2), np.ones(2))
ORNSTEIN_UHLENBECK = OrnsteinUhlenbeckActionNoise(np.zeros(2), np.ones(2))


def set_on_population(name, value, **arguments):
    population = make(2, **arguments)
    before = getattr(population, name, None)
    try:
        setattr(population, name, value)
    finally:
        assert getattr(population, name, None) == before


@pytest.mark.parametrize(
    ("make_it", "name"),
    [
        (lambda: make(0, env=make_env(1)), "agents"),
        (lambda: make([], env=make_env(1)), "agents"),
        (lambda: make([dict(), 3], env=make_env(2)), "agents[1]"),
        (lambda: make([dict(), dict(batch_size=16)]), "agents[1]['batch_size']"),
        (lambda: make([dict(), dict(cem_samples=16)]), "agents[1]['cem_samples']"),
        (lambda: make([dict(), dict(n_steps=2)]), "agents[1]['n_steps']"),
        (lambda: make([dict(n_steps=2), dict()]), "agents[1]['n_steps']"),
        (lambda: make([dict(), dict(train_freq=(2, "step"))]), "agents[1]['train_freq']"),
        (lambda: make([dict(), dict(policy_kwargs=dict(net_arch=[4]))]), "agents[1]['policy_kwargs']"),
        (lambda: make([dict(), dict(policy_training="offline")]), "agents[1]['policy_training']"),
        (lambda: make([dict(), dict(learning_speed=1)]), "arguments"),
        (lambda: make(2, learning_speed=1), "arguments"),
        (lambda: make([dict(), dict(tau=2.0)]), "tau"),
        (lambda: make([dict(), dict(learning_rate="fast")]), "learning_rate"),
        (lambda: make([dict(), dict(policy_delay=0)]), "policy_delay"),
        (lambda: make(2, policy_loss="huber"), "policy_loss"),
        (lambda: make(2, policy_loss="mine"), "policy_loss"),
        (lambda: make(3, env=make_env(2)), "env.num_envs"),
        (lambda: make(2, train_freq=(1, "episode")), "train_freq"),
        (lambda: make(2, cem_dtype="bfloat16"), "cem_dtype"),
        (lambda: make(2, optimize_memory_usage=True), "optimize_memory_usage"),
        (lambda: make(2, replay_buffer_class=ReplayBuffer), "replay_buffer_class"),
        (lambda: make(2, policy_kwargs=dict(optimizer_class=th.optim.SGD)), "policy_kwargs['optimizer_class']"),
        (
            lambda: make(2, policy_kwargs=dict(optimizer_kwargs=dict(weight_decay=0.1))),
            "policy_kwargs['optimizer_kwargs']['weight_decay']",
        ),
        (lambda: make(2, policy_kwargs=dict(activation_fn=nn.PReLU)), "policy_kwargs"),
        (lambda: Population("CnnPolicy", make_env(2), 2), "policy"),
        (lambda: Population(type("Own", (CGPPolicy,), {}), make_env(2), 2), "policy"),
        (lambda: make(2, env=VecNormalize(make_env(2))), "env"),
        (
            lambda: make(
                [
                    dict(action_noise=NOISE),
                    dict(action_noise=ORNSTEIN_UHLENBECK),
                ]
            ),
            "agents[1]['action_noise']",
        ),
        (lambda: make([dict(), dict(action_noise=ORNSTEIN_UHLENBECK)]), "agents[0]['action_noise']"),
        (lambda: make(2, action_noise=VectorizedActionNoise(ORNSTEIN_UHLENBECK, 2)), "agents[0]['action_noise']"),
        (lambda: Population("MlpPolicy", None, 2), "env"),
        (lambda: set_on_population("cem_iterations", 5), "cem_iterations"),
        (lambda: set_on_population("tau", 0.9), "tau"),
        (lambda: set_on_population("learning_rate", 0.1), "learning_rate"),
        (lambda: set_on_population("overlap", True), "overlap"),
        (lambda: set_on_population("overlap", True, train_freq=2), "overlap"),
        (lambda: set_on_population("overlap", False, overlap=True), "overlap"),
        (lambda: set_on_population("agents", [dict(tau=0.9)] * 2), "agents"),
        (lambda: set_on_population("policy_kwargs", dict(net_arch=[4])), "policy_kwargs"),
        (lambda: set_on_population("action_noise", NOISE), "action_noise"),
        (lambda: set_on_population("action_noise", None, action_noise=NOISE), "action_noise"),
        (lambda: set_on_population("action_noise", None, action_noise=ORNSTEIN_UHLENBECK), "action_noise"),
        (lambda: make(3).predict(np.zeros((2, 3))), "observation"),
        (lambda: evaluate_population(make(3), make_env(2)), "env.num_envs"),
    ],
)
def test_what_is_not_possible_is_refused_by_name(make_it, name, monkeypatch):
    # A loss of the user's own, which a population would not compute
    monkeypatch.setitem(POLICY_LOSSES, "mine", lambda policy, observations: policy.actor(observations).square().mean())
    with pytest.raises(ValueError, match="must be") as error:
        make_it()
    assert f"`{name}`" in str(error.value)


@pytest.mark.parametrize(
    "given",
    [
        dict(n_steps=1),
        dict(train_freq=(1, "step")),
        dict(policy_loss="cgp", policy_training="online", inference=None, cuda_graphs=True),
        dict(replay_buffer_kwargs={}),
    ],
)
@pytest.mark.parametrize("first", [True, False])
def test_a_default_that_one_agent_is_given_is_no_difference(given, first):
    agents = [given, dict()] if first else [dict(), given]
    population = make(agents)
    assert (population.n_steps, population.train_freq.frequency) == (1, 1)
    assert len({agent.policy.inference for agent in population}) == 1


def test_the_selector_is_unchanged():
    selector = CEM(3, 10, 2)
    population = make(2, policy_kwargs=dict(selector=selector))
    assert population.policy.selector is selector


def test_what_is_no_argument_of_the_agents_may_be_set():
    population = make(2)
    population.verbose = 1
    population.tensorboard_log = None
    assert population.verbose == 1


def test_seeds_count_beyond_the_range_of_a_small_integer():
    assert [agent["seed"] for agent in make(2, seed=np.uint8(255)).agents] == [255, 256]
