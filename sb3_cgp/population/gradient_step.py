"""
A gradient step of all agents ("Train on replay buffer" of Algorithm 2), in the order of ``core/cgp.py``.

Nothing here synchronises with the host, and all state is changed in place, so that a CUDA graph can be made of it.

Shapes: N agents, C critics per agent, B transitions per agent, A action dimensions.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch as th

from sb3_cgp.algorithm import CGP
from sb3_cgp.fast.cuda_graphs import Tensors
from sb3_cgp.population.networks import StackedMLP
from sb3_cgp.population.policies import PopulationPolicy


@dataclass(frozen=True)
class AgentNumbers:
    """
    The agents' hyperparameters on the device, (N, 1) each, and ``taus``, (N, 1, 1).

    :param gammas: discount factors
    :param taus: coefficients of the averages' updates
    :param noise_stds: standard deviations of the target actions' noise
    :param noise_clips: largest magnitudes of that noise
    """

    gammas: th.Tensor
    taus: th.Tensor
    noise_stds: th.Tensor
    noise_clips: th.Tensor

    @classmethod
    def of(cls, agents: Sequence[CGP], device: th.device) -> "AgentNumbers":
        """
        Collect the hyperparameters of agents.

        :param agents: the agents
        :param device: the device of the networks
        :return: the hyperparameters
        """

        def collect(name: str) -> th.Tensor:
            values = [float(getattr(agent, name)) for agent in agents]
            return th.tensor(values, dtype=th.get_default_dtype(), device=device).unsqueeze(1)

        taus = collect("tau").unsqueeze(2)
        return cls(collect("gamma"), taus, collect("target_policy_noise"), collect("target_noise_clip"))


class GradientStep:
    """
    The gradient step of a population.

    :param policy: the networks and their optimizers
    :param numbers: the agents' hyperparameters
    :param policy_loss: the actors' loss: "cgp" or "qgp"; None where no actor is trained
    :param trains_actors: whether some agent may be due to train its actor
    :param moves_averages: whether some agent may be due to update its averages
    """

    def __init__(
        self,
        policy: PopulationPolicy,
        numbers: AgentNumbers,
        policy_loss: str | None,
        trains_actors: bool,
        moves_averages: bool,
    ):
        self._policy = policy
        self._numbers = numbers
        self._policy_loss = policy_loss
        self._trains_actors = trains_actors
        self._moves_averages = moves_averages

    def __call__(
        self,
        observations: th.Tensor,
        actions: th.Tensor,
        next_observations: th.Tensor,
        dones: th.Tensor,
        rewards: th.Tensor,
        discounts: th.Tensor,
        due: th.Tensor,
    ) -> Tensors:
        """
        Update the critics, the actors and their averages.

        :param observations: the fields of :class:`~sb3_cgp.population.replay.AgentSamples`, as the next five
        :param actions: see there
        :param next_observations: see there
        :param dones: see there
        :param rewards: see there
        :param discounts: see there
        :param due: integers, (4, N): the number of each agent's gradient step, and whether (1 or 0) it trains its critics,
            trains its actor, and updates its averages in this step
        :return: the losses of the critics, (N,), the mean values of the first critics, (N,), and the losses of the actors,
            (N,), or None
        """
        policy, numbers = self._policy, self._numbers
        n_updates, learns, trains_actor, moves_averages = due[0], *due[1:].bool()
        features = policy.features(observations)
        with th.no_grad():
            next_features = policy.features(next_observations)
            targets = rewards + (1 - dones) * discounts * self._next_values(next_features)

        # Update the critics
        q_values = policy.q_values(policy.critics, features, actions)
        critic_losses = (q_values - targets).square().mean(dim=2).sum(dim=0)
        self._descend("critic", critic_losses, learns, n_updates)

        # Update the actors: as in TD3, their loss sees the updated critics
        actor_losses = None
        if self._trains_actors:
            actor_losses = self._actor_losses(features)
            self._descend("actor", actor_losses, trains_actor, n_updates)
            actor_losses = actor_losses.detach()

        if self._moves_averages:
            shares = th.where(self._healthy(moves_averages).view(-1, 1, 1), numbers.taus, 0.0)
            _update_averages(policy.critics, policy.target_critics, shares)
            _update_averages(policy.actors, policy.averaged_actors, shares)
        return critic_losses.detach(), q_values[0].detach().mean(dim=1), actor_losses

    def _next_values(self, features: th.Tensor) -> th.Tensor:
        """Return the values of the next states, (N, B): the minimum over the target critics at smoothed actions."""
        policy, numbers = self._policy, self._numbers
        actions = policy.select_actions(features, by_targets=True)
        noise = th.randn(actions.shape, device=actions.device) * numbers.noise_stds.unsqueeze(2)
        clips = numbers.noise_clips.unsqueeze(2)
        actions = (actions + noise.clamp(-clips, clips)).clamp(-1, 1)
        return policy.q_values(policy.target_critics, features, actions).amin(dim=0)

    def _actor_losses(self, features: th.Tensor) -> th.Tensor:
        """Return the actors' losses, (N,), those of ``core/losses.py``."""
        policy = self._policy
        actions: th.Tensor = policy.actors(features)[0]
        if self._policy_loss == "cgp":
            return (actions - policy.select_actions(features)).square().mean(dim=(1, 2))
        return -policy.q_values(policy.critics, features, actions, n_critics=1)[0].mean(dim=1)

    def _descend(self, name: str, losses: th.Tensor, due: th.Tensor, n_updates: th.Tensor) -> None:
        """Take an optimizer step down the losses, (N,), with agents that are due. Note which of them are not finite."""
        policy = self._policy
        networks, optimizer = getattr(policy, f"{name}s"), getattr(policy, f"{name}_optimizer")
        failed_at = policy.failed_at[("critic", "actor").index(name)]
        due = self._healthy(due)
        failed_at.copy_(th.where(due & ~losses.isfinite(), n_updates, failed_at))
        parameters = networks.ordered()
        # No agent's loss depends on the parameters of another one
        gradients = th.autograd.grad(losses.sum(), parameters)
        optimizer.step(parameters, gradients, self._healthy(due).view(-1, 1, 1))

    def _healthy(self, due: th.Tensor) -> th.Tensor:
        """Return which agents that are due have not failed, (N,)."""
        return due & (self._policy.failed_at < 0).all(dim=0)


@th.no_grad()
def _update_averages(networks: StackedMLP, averages: StackedMLP, shares: th.Tensor) -> None:
    """Move Polyak averages towards their networks by each agent's share, (N, 1, 1)."""
    for parameter, average in zip(networks.ordered(), averages.ordered(), strict=True):
        average.lerp_(parameter, shares)
