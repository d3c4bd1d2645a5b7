"""A population of agents: each of them computes what a CGP alone computes, given the same minibatches and random numbers."""

import itertools

import numpy as np
import pytest
import torch as th
from populations import AGENTS, VARIANTS, Pushed, PushedOnAxes, adam_state, assert_alike, make, make_env
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from sb3_cgp import CGP


class Step:
    """What one gradient step of a population was given: minibatches, what was due, progress, and draws, in their order."""

    def __init__(self, population, inputs):
        *self.batch, self.due = inputs
        self.progress = population._current_progress_remaining
        self.draws = []


def record(population, monkeypatch):
    """Record all gradient steps of a population."""
    steps, randn, carry_out = [], th.randn, population._carry_out

    def drawing(*args, **kwargs):
        steps[-1].draws.append(randn(*args, **kwargs))
        return steps[-1].draws[-1].clone()

    def carrying_out(due, inputs):
        steps.append(Step(population, inputs))
        with monkeypatch.context() as patch:
            patch.setattr(th, "randn", drawing)
            return carry_out(due, inputs)

    monkeypatch.setattr(population, "_carry_out", carrying_out)
    return steps


class OneBatch(ReplayBuffer):
    """A buffer that returns a given minibatch."""

    def __init__(self, batch):
        self.batch = batch

    def size(self):
        return len(self.batch.rewards)

    def sample(self, batch_size, env=None):
        assert batch_size == len(self.batch.rewards)
        return self.batch


def repeat_alone(alone, index, step, monkeypatch):
    """Let a CGP alone do the gradient step that an agent of a population did."""
    observations, actions, next_observations, dones, rewards, discounts = (field[index] for field in step.batch)
    given = None if alone.n_steps == 1 else discounts.unsqueeze(1)
    # The core multiplies `dones` by gamma, which their data type rounds
    dones = dones.unsqueeze(1).to(th.get_default_dtype())
    fields = observations, actions, next_observations, dones, rewards.unsqueeze(1), given
    alone.replay_buffer = OneBatch(ReplayBufferSamples(*fields))
    alone._current_progress_remaining = step.progress
    n_agents = len(step.batch[0])
    draws = iter(
        [draw.unflatten(0, (n_agents, -1))[index] if draw.shape[0] != n_agents else draw[index] for draw in step.draws]
    )

    def drawing(shape, **kwargs):
        draw = next(draws)
        assert draw.shape == shape
        return draw.clone()

    with monkeypatch.context() as patch:
        patch.setattr(th, "randn", drawing)
        patch.setattr(th.Tensor, "normal_", lambda self, mean, std: self.copy_(mean + std * drawing(self.shape)))
        alone.train(1, alone.batch_size)
    return draws


def alone_like(population, index):
    """Make the CGP that agent i would be alone, and check that the population's begins with its networks."""
    alone = CGP("MlpPolicy", Pushed(), **population.agents[index], device="cpu", diagnostics=False)
    alone.set_logger(population.logger)
    return alone


@pytest.mark.parametrize("variant", VARIANTS)
def test_an_agent_computes_what_a_cgp_alone_computes(variant, float64, monkeypatch):
    kwargs = VARIANTS[variant]
    agents = [own | {name: kwargs[name] for name in ("policy_delay",) if name in kwargs and own} for own in AGENTS]
    population = make(agents, gradient_steps=2, **kwargs)
    initial = [{name: value.clone() for name, value in agent.policy.state_dict().items()} for agent in population]
    steps = record(population, monkeypatch)
    # Offline training comes after the gradient steps that are compared here
    monkeypatch.setattr(population, "_train_policies", lambda: None)
    population.learn(3 * 63)
    assert len(steps) == 2 * 43
    assert list(population._agent_updates) == [2 * 43, 2 * 41, 2 * 43]
    for index, agent in enumerate(population):
        alone = alone_like(population, index)
        assert all(th.equal(initial[index][name], value) for name, value in alone.policy.state_dict().items())
        for step in steps:
            if step.due[1, index]:
                repeat_alone(alone, index, step, monkeypatch)
        assert_alike(agent, alone, rtol=1e-6, atol=1e-9)
        moved = (agent.critic.state_dict()[name] - initial[index][f"critic.{name}"] for name in agent.critic.state_dict())
        assert max(each.abs().max().item() for each in moved) > 0.01
        assert all(adam_state(agent, "actor")) == population._trains_online


@pytest.mark.parametrize("variant", ["CGP", "TD3"])
def test_an_agent_is_a_cgp_alone_in_single_precision_too(variant, monkeypatch):
    population = make(AGENTS, gradient_steps=2, **VARIANTS[variant])
    steps = record(population, monkeypatch)
    population.learn(3 * 63)
    for index, agent in enumerate(population):
        alone = alone_like(population, index)
        for step in steps:
            if step.due[1, index]:
                repeat_alone(alone, index, step, monkeypatch)
        for name, value in alone.policy.state_dict().items():
            th.testing.assert_close(agent.policy.state_dict()[name], value, rtol=0, atol=2e-3, msg=name)


@pytest.mark.parametrize(
    ("variant", "env"),
    [(name, Pushed) for name in ("CGP", "QGP", "CEM", "CGP-Light", "MPPI from the actor", "TD3", "n-step")]
    + [(name, PushedOnAxes) for name in ("CGP", "CGP-Light", "MPPI from the actor", "TD3", "n-step")],
)
def test_a_population_of_one_is_a_cgp_alone_from_the_first_step(variant, env, float64):
    """Environment, warm-up, acting, noise, minibatches and gradient steps, on the same random numbers."""
    noise = NormalActionNoise(np.zeros(env.action_space.shape), 0.1 * np.ones(env.action_space.shape))
    # A gamma that is exact in single precision, to which the core rounds it
    kwargs = VARIANTS[variant] | dict(action_noise=noise, gamma=0.5)
    population = make(1, make_env(1, env), **kwargs).learn(110)
    alone = CGP("MlpPolicy", make_env(1, env), **population.agents[0], device="cpu").learn(110)
    assert alone._n_updates == 90
    np.testing.assert_allclose(population.replay_buffer.actions[:110], alone.replay_buffer.actions[:110], atol=1e-4)
    np.testing.assert_array_equal(population.replay_buffer.observations[:110], alone.replay_buffer.observations[:110])
    # Buffers round to single precision, and MPPI magnifies that
    assert_alike(population[0], alone, rtol=1e-3, atol=1e-4)


def test_agents_differ_and_each_begins_as_its_seed_says():
    population = make(3, env="Pendulum-v1").learn(3 * 40)
    assert population.num_timesteps == 120
    assert [agent.num_timesteps for agent in population] == [40] * 3
    assert [agent.seed for agent in population] == [0, 1, 2]
    observations = population.replay_buffer.observations[0, :, :]
    for index in range(3):
        alone = CGP("MlpPolicy", "Pendulum-v1", **population.agents[index], device="cpu").learn(1)
        np.testing.assert_array_equal(observations[index], alone.replay_buffer.observations[0, 0])
    weights = [agent.actor.mu[0].weight for agent in population]
    assert not any(th.allclose(*pair) for pair in itertools.combinations(weights, 2))
    assert all(weight.isfinite().all() for weight in weights)
    with pytest.raises(IndexError):
        population[3]
    assert th.equal(population[-1].actor.mu[0].weight, weights[2])


def test_gradient_steps_follow_the_steps_of_one_environment():
    population = make(2, train_freq=(3, "step"), gradient_steps=-1).learn(2 * 38)
    # Rollouts of three steps, the seventh of which ends beyond the warm-up
    assert population.num_timesteps == 2 * 39
    assert list(population._agent_updates) == [3 * 7, 3 * 7]
    alone = CGP("MlpPolicy", Pushed(), **population.agents[0], device="cpu").learn(38)
    assert alone._n_updates == 21


def test_an_agent_without_a_seed_leaves_its_environment_the_one_that_it_has():
    env = make_env(3)
    env.seed(11)
    population = make([dict(seed=None), dict(seed=3), dict(seed=None)], env=env)
    assert population.get_env()._seeds == [11, 3, 13]
