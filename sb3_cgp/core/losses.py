"""
The losses from which the actor learns. A new one is a function here and an entry of ``POLICY_LOSSES``.

Each takes the policy and a batch of observations, as tensors, and returns a scalar.
"""

from collections.abc import Callable

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs
from torch.nn import functional as F

from sb3_cgp.core.policies import CGPPolicy


def cgp_loss(policy: CGPPolicy, observations: PyTorchObs) -> th.Tensor:
    """Return the mean squared error between the actor's actions and CEM's, ``(π(s) - π_CEM(s))²`` ("CGP loss")."""
    return F.mse_loss(policy.actor(observations), policy.select_actions(observations, policy.critic).actions)


def qgp_loss(policy: CGPPolicy, observations: PyTorchObs) -> th.Tensor:
    """Return the negative value that the first critic gives to the actor's actions, ``-Q_1(s, π(s))`` ("QGP loss")."""
    # SB3's type hint omits the tensors of a Dict space
    q_values = policy.critic.q1_forward(observations, policy.actor(observations))  # type: ignore[arg-type]
    return -q_values.mean()


POLICY_LOSSES: dict[str, Callable[[CGPPolicy, PyTorchObs], th.Tensor]] = {"cgp": cgp_loss, "qgp": qgp_loss}
