"""Adam of a population: PyTorch's for each agent that is due, and no change for the others."""

import math

import pytest
import torch as th
from populations import make
from torch import nn

from sb3_cgp.population.adam import AgentAdam


@pytest.mark.parametrize("dtype", [th.float32, th.float64])
def test_adam_is_pytorchs_for_each_agent_that_is_due(dtype):
    th.manual_seed(0)
    shapes = [(2, 3, 4, 5), (2, 3, 1, 4)]
    parameters = [th.randn(shape, dtype=dtype) for shape in shapes]
    optimizer = AgentAdam(parameters, betas=(0.8, 0.99), eps=1e-6).to(dtype)
    rates = [1e-1, 1e-3, 3e-2]
    optimizer.rates.copy_(th.tensor(rates, dtype=dtype).view(3, 1, 1))
    alone = [[nn.Parameter(each[:, agent].clone()) for each in parameters] for agent in range(3)]
    theirs = [th.optim.Adam(own, lr=rate, betas=(0.8, 0.99), eps=1e-6) for own, rate in zip(alone, rates, strict=True)]
    for step in range(1, 301):
        due = th.tensor([True, step % 3 == 0, step > 50])
        gradients = [th.randn(shape, dtype=dtype) * 10 ** th.randn(()) for shape in shapes]
        # Agents that are not due may have any gradient
        given = [th.where(due.view(3, 1, 1), gradient, math.nan) for gradient in gradients]
        optimizer.step(parameters, given, due.view(3, 1, 1))
        for agent in range(3):
            if due[agent]:
                for parameter, gradient in zip(alone[agent], gradients, strict=True):
                    parameter.grad = gradient[:, agent].clone()
                theirs[agent].step()
        tolerance = dict(rtol=0, atol=1e-9 if dtype == th.float64 else 1e-4)
        for agent in range(3):
            for parameter, own in zip(parameters, alone[agent], strict=True):
                th.testing.assert_close(parameter[:, agent], own.detach(), **tolerance)
    assert optimizer.steps.flatten().tolist() == [300, 100, 250]


def test_an_agent_that_is_not_due_stays_as_it_is_to_the_bit():
    population = make([dict(), dict(learning_starts=10_000), dict(policy_delay=10_000, target_update_interval=10_000)])
    before = [agent.policy.state_dict() for agent in population]
    population.learn(3 * 60)
    changed = [
        {
            name.partition(".")[0]
            for name, value in agent.policy.state_dict().items()
            if not th.equal(before[index][name], value)
        }
        for index, agent in enumerate(population)
    ]
    assert changed == [{"actor", "critic", "actor_target", "critic_target"}, set(), {"critic"}]
    assert population[1]._n_updates == len(population[1].critic.optimizer.state) == 0
    assert len(population[2].critic.optimizer.state) > 0
    assert len(population[2].actor.optimizer.state) == 0
