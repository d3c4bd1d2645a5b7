"""
The paper's losses and targets (Algorithm 2), as pure functions of tensors.

Shapes: B transitions, A action dimensions.
"""

from collections.abc import Iterable

import torch as th
from torch.nn import functional as F


def smooth_target_actions(actions: th.Tensor, noise_std: float, noise_clip: float) -> th.Tensor:
    """
    Add clipped Gaussian noise to target actions, as TD3 does.

    :param actions: target actions, (B, A), within [-1, 1]
    :param noise_std: standard deviation of the noise, in the scaled action space
    :param noise_clip: bound on the noise's absolute value
    :return: noisy actions, (B, A), within [-1, 1]
    """
    noise = th.empty_like(actions).normal_(0, noise_std).clamp(-noise_clip, noise_clip)
    return (actions + noise).clamp(-1, 1)


def bootstrap_target(
    rewards: th.Tensor, dones: th.Tensor, discounts: th.Tensor | float, next_q_values: Iterable[th.Tensor]
) -> th.Tensor:
    """
    Compute the critics' common target, ``q* = r + γ (1 - d) min_j Q'_j(s', a')``.

    :param rewards: rewards, (B, 1)
    :param dones: 1 where the episode terminated (not where it ran out of time), else 0, (B, 1)
    :param discounts: discount factor γ, or one per transition, (B, 1), for n-step returns
    :param next_q_values: each target critic's value of the next state and action, (B, 1)
    :return: targets, (B, 1)
    """
    smallest = th.cat(tuple(next_q_values), dim=1).min(dim=1, keepdim=True).values
    return rewards + (1 - dones) * discounts * smallest


def critic_loss(q_values: Iterable[th.Tensor], targets: th.Tensor) -> th.Tensor:
    """
    Sum the critics' mean squared errors, ``Σ_j (Q_j(s, a) - q*)²``.

    :param q_values: each critic's values, (B, 1)
    :param targets: bootstrap targets, (B, 1)
    :return: the loss, a scalar
    """
    return th.stack([F.mse_loss(values, targets) for values in q_values]).sum()


def cgp_loss(actor_actions: th.Tensor, cem_actions: th.Tensor) -> th.Tensor:
    """
    Compute the mean squared error of the actor that imitates CEM, ``(π(s) - π_CEM(s))²``.

    :param actor_actions: the actor's actions, (B, A)
    :param cem_actions: the actions that CEM selects for the same states, (B, A)
    :return: the loss, a scalar
    """
    return F.mse_loss(actor_actions, cem_actions)


def qgp_loss(q_values: th.Tensor) -> th.Tensor:
    """
    Compute the loss of the actor that climbs the first critic, ``-Q_1(s, π(s))``.

    :param q_values: the first critic's values of the actor's actions, (B, 1)
    :return: the loss, a scalar
    """
    return -q_values.mean()
