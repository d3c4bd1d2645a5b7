"""
Columns of a replay buffer: environment i's transitions, which are agent i's.

Shapes: N agents, B transitions per agent.
"""

import copy
from typing import Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer


class AgentSamples(NamedTuple):
    """
    A minibatch of each agent.

    :param observations: observations, (N, B, *shape)
    :param actions: actions in the scaled action space, (N, B, A)
    :param next_observations: next observations, (N, B, *shape)
    :param dones: 1 for a termination, else 0, (N, B)
    :param rewards: rewards, or n-step returns, (N, B)
    :param discounts: discount factors of the next values, (N, B) with n-step returns, else (N, 1)
    """

    observations: th.Tensor
    actions: th.Tensor
    next_observations: th.Tensor
    dones: th.Tensor
    rewards: th.Tensor
    discounts: th.Tensor


def sample_columns(buffer: ReplayBuffer, batch_size: int, gammas: th.Tensor) -> AgentSamples:
    """
    Sample a minibatch of each agent from its column, with row numbers of its own.

    :param buffer: a replay buffer of N environments
    :param batch_size: number of transitions per agent
    :param gammas: the agents' discount factors, (N, 1)
    :return: the minibatches
    """
    if isinstance(buffer, NStepReplayBuffer):
        return _sample_n_steps(buffer, batch_size, gammas)
    n_agents = buffer.n_envs
    # SB3's generator
    rows: Any = np.random.randint(0, buffer.size(), size=(n_agents, batch_size))  # noqa: NPY002
    columns: Any = np.arange(n_agents)[:, np.newaxis]
    if isinstance(buffer.rewards, th.Tensor):
        device = buffer.rewards.device
        rows, columns = (th.from_numpy(each).to(device, non_blocking=True) for each in (rows, columns))
    names = ("observations", "actions", "next_observations", "dones", "timeouts", "rewards")
    fields = [th.as_tensor(getattr(buffer, name)[rows, columns], device=buffer.device) for name in names]
    observations, actions, next_observations, dones, timeouts, rewards = fields
    # A timeout is not a termination (Appendix C)
    return AgentSamples(observations, actions, next_observations, dones * (1 - timeouts), rewards, gammas)


def _sample_n_steps(buffer: NStepReplayBuffer, batch_size: int, gammas: th.Tensor) -> AgentSamples:
    """Sample n-step returns, of one agent after the other, as SB3's buffer has one discount factor."""
    batches = []
    for agent, gamma in enumerate(gammas.flatten().tolist()):
        own = column(buffer, agent)
        assert isinstance(own, NStepReplayBuffer)
        own.gamma = gamma
        batches.append(own.sample(batch_size))
    observations, actions, next_observations, dones, rewards, discounts = (
        th.stack(each) for each in zip(*batches, strict=True)
    )
    return AgentSamples(observations, actions, next_observations, dones.squeeze(2), rewards.squeeze(2), discounts.squeeze(2))


def column(buffer: ReplayBuffer, agent: int) -> ReplayBuffer:
    """
    Return one agent's column as a replay buffer of one environment that shares the memory.

    :param buffer: the replay buffer of all agents
    :param agent: the agent's index
    :return: the column, of the same class
    """
    own = type(buffer).__new__(type(buffer))
    vars(own).update(vars(buffer), n_envs=1)
    for name, value in vars(buffer).items():
        is_stored = isinstance(value, np.ndarray | th.Tensor) and value.shape[:2] == (buffer.buffer_size, buffer.n_envs)
        if is_stored:
            setattr(own, name, value[:, agent : agent + 1])
    return own


def copied_column(buffer: ReplayBuffer, agent: int) -> ReplayBuffer:
    """
    Return a copy of one agent's column as a replay buffer of one environment.

    :param buffer: the replay buffer of all agents
    :param agent: the agent's index
    :return: the copy
    """
    return copy.deepcopy(column(buffer, agent))
