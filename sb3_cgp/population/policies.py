"""
The policy of a population: the stacked networks of all agents, and the action selector that they share.

Shapes: N agents, B states per agent, F features, A action dimensions.
"""

import copy
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_cgp.algorithm import CGP
from sb3_cgp.common.rules import require
from sb3_cgp.core.policies import CGPPolicy
from sb3_cgp.population.adam import AgentAdam
from sb3_cgp.population.networks import StackedMLP, StackedScore, agent_slices
from sb3_cgp.selectors.proposals import takes_proposals

# Returns the actions that agents take at their observations, (N, *shape)
SelectFunction = Callable[[th.Tensor], th.Tensor]


class PopulationPolicy(BasePolicy):
    """
    The networks of N agents, and their optimizers.

    A batch of observations has one row for each agent: row i is acted on by agent i.

    :param observation_space: observation space of one agent
    :param action_space: action space of one agent
    :param agents: the agents, whose networks are copied
    """

    # The core's method, which needs no more than the attribute `inference`
    acting_by: Callable[..., AbstractContextManager[None]] = CGPPolicy.acting_by
    actor_optimizer: AgentAdam
    critic_optimizer: AgentAdam
    failed_at: th.Tensor
    _has_actor: th.Tensor
    # Carries a selection of actions out, as a CUDA graph while a population is trained; None for an ordinary call
    recorded_selection: Callable[[SelectFunction, th.Tensor], th.Tensor] | None = None

    def __init__(self, observation_space: spaces.Box, action_space: spaces.Box, agents: Sequence[CGP]):
        first = agents[0]
        scales = first.policy.normalize_images
        super().__init__(observation_space, action_space, squash_output=True, normalize_images=scales)
        self.features_extractor = self.make_features_extractor()
        self.n_agents = len(agents)
        self.selector = first.policy.selector
        self.inference = first.policy.inference
        self.actors = StackedMLP([[agent.actor.mu] for agent in agents])
        self.critics = StackedMLP([agent.critic.q_networks for agent in agents])
        self.averaged_actors = StackedMLP([[agent.actor_target.mu] for agent in agents])
        self.target_critics = StackedMLP([agent.critic_target.q_networks for agent in agents])
        self.averaged_actors.requires_grad_(False)
        self.target_critics.requires_grad_(False)
        self.actor_optimizer = AgentAdam.like(first.actor.optimizer, self.actors.ordered())
        self.critic_optimizer = AgentAdam.like(first.critic.optimizer, self.critics.ordered())
        # The agent's gradient step whose loss was NaN or infinite, of the critic and of the actor; -1 for none
        self.register_buffer("failed_at", th.full((2, self.n_agents), -1, dtype=th.long))
        # Not saved, as the population sets it when it is loaded. On the device, for CUDA graphs.
        self.register_buffer("_has_actor", th.ones(self.n_agents, dtype=th.bool), persistent=False)
        self.set_actors([True] * self.n_agents)

    def set_actors(self, has_actor: Iterable[bool]) -> None:
        """
        Set which agents have a trained actor: it acts and proposes for these agents alone, the selector acts for the others.

        :param has_actor: whether each agent has one
        """
        self.has_actor = tuple(map(bool, has_actor))
        self._has_actor.copy_(th.tensor(self.has_actor))

    def features(self, observations: th.Tensor) -> th.Tensor:
        """
        Return the features of observations.

        :param observations: the observations, (N, B, *shape)
        :return: their features, (N, B, F)
        """
        features: th.Tensor = self.extract_features(observations.flatten(0, 1), self.features_extractor)
        return features.unflatten(0, observations.shape[:2])

    def q_values(
        self, critics: StackedMLP, features: th.Tensor, actions: th.Tensor, n_critics: int | None = None
    ) -> th.Tensor:
        """
        Return the critics' values of actions.

        :param critics: the critics, or the target critics
        :param features: the states' features, (N, B, F)
        :param actions: an action for each state, (N, B, A)
        :param n_critics: number of critics of each agent, the first ones; None for all, C
        :return: the values, (C, N, B)
        """
        values: th.Tensor = critics(th.cat([features, actions], dim=2), n_critics)
        return values.squeeze(3)

    @th.no_grad()
    def select_actions(self, features: th.Tensor, by_targets: bool = False) -> th.Tensor:
        """
        Select the actions that each agent's first critic rates highest, as ``CGPPolicy.select_actions`` does.

        :param features: the states' features, (N, B, F)
        :param by_targets: whether the target critics are evaluated, and the averaged actors propose
        :return: the actions, (N, B, A), in the scaled action space
        """
        critics, actors = (self.target_critics, self.averaged_actors) if by_targets else (self.critics, self.actors)
        if not takes_proposals(self.selector) or not any(self.has_actor):
            return self._select(critics, features)
        proposing = self._select(critics, features, proposals=actors(features)[0].flatten(0, 1).unsqueeze(1))
        return proposing if all(self.has_actor) else self._where_actor(proposing, self._select(critics, features))

    def _select(self, critics: StackedMLP, features: th.Tensor, **arguments: th.Tensor) -> th.Tensor:
        """Select each state's action, (N, B, A), by the values of some critics."""
        assert self.selector is not None
        n_rows, action_dim = features.shape[0] * features.shape[1], get_action_dim(self.action_space)
        selection = self.selector.select(StackedScore(critics, features), n_rows, action_dim, features.device, **arguments)
        return selection.actions.unflatten(0, features.shape[:2])

    def _where_actor(self, actions: th.Tensor, others: th.Tensor) -> th.Tensor:
        """Return the actions of the agents that have a trained actor, and other actions of the others, (N, ..., A)."""
        return th.where(self._has_actor.view(-1, *[1] * (actions.dim() - 1)), actions, others)

    def set_training_mode(self, mode: bool) -> None:
        """
        Put the policy in either training or evaluation mode.

        :param mode: if true, set to training mode, else set to evaluation mode
        """
        # SB3 sets the mode at every prediction, which visits every module
        if self.training != mode:
            super().set_training_mode(mode)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        assert isinstance(observation, th.Tensor)
        n_rows = observation.shape[0]
        allowed = f"of {self.n_agents} rows, one for each agent: `population[i]` acts on the observations of agent i alone"
        require(n_rows == self.n_agents, "observation", f"{n_rows} rows", allowed)
        if self.inference == "cem":
            recorded = self.recorded_selection
            return self._act_by_selector(observation) if recorded is None else recorded(self._act_by_selector, observation)
        actors = self.averaged_actors if self.inference == "averaged_actor" else self.actors
        actions: th.Tensor = actors(self.features(observation.unsqueeze(1)))[0].squeeze(1)
        return actions if all(self.has_actor) else self._where_actor(actions, self._act_by_selector(observation))

    def _act_by_selector(self, observation: th.Tensor) -> th.Tensor:
        """Select each agent's action, (N, A), at its observation."""
        return self.select_actions(self.features(observation.unsqueeze(1))).squeeze(1)

    def _pairs(self, agent: CGP) -> Iterator[tuple[StackedMLP, nn.Module]]:
        """List the stacked networks, each with the same network of an agent."""
        yield self.actors, agent.actor
        yield self.critics, agent.critic
        yield self.averaged_actors, agent.actor_target
        yield self.target_critics, agent.critic_target

    @th.no_grad()
    def copy_to(self, agent: CGP, index: int) -> None:
        """
        Copy one agent's networks and optimizers' states into an ordinary CGP.

        :param agent: the CGP
        :param index: the agent's index
        """
        for networks, network in self._pairs(agent):
            for parameter, value in zip(network.parameters(), agent_slices(networks.ordered(), index), strict=True):
                parameter.copy_(value.view_as(parameter))
        states: dict[str, Any] = {"policy": copy.deepcopy(agent.policy.state_dict())}
        for name, optimizer in (("actor", self.actor_optimizer), ("critic", self.critic_optimizer)):
            ordinary = getattr(agent, name).optimizer
            state = states[f"{name}.optimizer"] = ordinary.state_dict()
            if optimizer.steps[index].item() == 0:
                continue
            moments = zip(*(agent_slices(optimizer.moments(each), index) for each in ("exp_avg", "exp_avg_sq")), strict=True)
            parameters = ordinary.param_groups[0]["params"]
            state["state"] = {
                number: {
                    "step": optimizer.steps[index].flatten()[0].clone(),
                    "exp_avg": exp_avg.view_as(parameter).clone(),
                    "exp_avg_sq": exp_avg_sq.view_as(parameter).clone(),
                }
                for number, (parameter, (exp_avg, exp_avg_sq)) in enumerate(zip(parameters, moments, strict=True))
            }
        # Also prepares what depends on the optimizers' memory
        agent.set_parameters(states, device=agent.device)

    @th.no_grad()
    def copy_actor_from(self, agent: CGP, index: int) -> None:
        """
        Copy the actor, its average and its optimizer's state of an ordinary CGP, which has trained the actor alone.

        :param agent: the CGP
        :param index: the agent's index
        """
        for networks, network in ((self.actors, agent.actor), (self.averaged_actors, agent.actor_target)):
            for parameter, value in zip(network.parameters(), agent_slices(networks.ordered(), index), strict=True):
                value.copy_(parameter.view_as(value))
        optimizer = agent.actor.optimizer
        if not optimizer.state:
            return
        parameters = optimizer.param_groups[0]["params"]
        self.actor_optimizer.steps[index] = optimizer.state[parameters[0]]["step"]
        for name in ("exp_avg", "exp_avg_sq"):
            moments = agent_slices(self.actor_optimizer.moments(name), index)
            for parameter, value in zip(parameters, moments, strict=True):
                value.copy_(optimizer.state[parameter][name].view_as(value))
