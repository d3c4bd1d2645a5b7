"""The agents of a population as ordinary CGPs."""

import copy
import operator
from collections.abc import Iterator
from typing import Any, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.type_aliases import GymEnv

from sb3_cgp.algorithm import CGP
from sb3_cgp.common.random_state import preserved_random_state
from sb3_cgp.population.arguments import make_agent
from sb3_cgp.population.overlap import OverlappedTraining
from sb3_cgp.population.replay import copied_column

SelfMembers = TypeVar("SelfMembers", bound="PopulationMembers")


class AgentLogger(Logger):
    """
    The log of one agent: to the outputs of the population's, with the agent's index in the keys.

    :param logger: the population's logger
    :param index: the agent's index
    """

    def __init__(self, logger: Logger, index: int):
        super().__init__(logger.dir, logger.output_formats)
        self._index = index

    def record(self, key: str, value: Any, exclude: str | tuple[str, ...] | None = None) -> None:
        """
        Log a value of the agent's.

        :param key: the key, to which the index is added
        :param value: the value
        :param exclude: outputs to leave out
        """
        super().record(f"{key}/agent_{self._index}", value, exclude)


class PopulationMembers(OverlappedTraining):
    """The part of :class:`~sb3_cgp.population.algorithm.Population` that copies its agents into CGPs, and back."""

    def set_parameters(self, load_path_or_dict: Any, exact_match: bool = True, device: th.device | str = "auto") -> None:
        """
        Load parameters, see SB3's method. As in a CGP alone, the loaded actors of agents that have not learnt yet then act if
        their optimizers' states show that they have been trained.

        :param load_path_or_dict: path to the file, an open file, or the parameters by module
        :param exact_match: whether the parameters of every module must be given
        :param device: the device on which the parameters are loaded
        """
        super().set_parameters(load_path_or_dict, exact_match, device)
        steps = self.policy.actor_optimizer.steps.flatten().numpy(force=True)
        self._policies_trained |= (steps > 0) & (self._agent_updates == 0) & self._trains_offline
        self._choose_inference()

    def __len__(self) -> int:
        return len(self.agents)

    def __iter__(self) -> Iterator[CGP]:
        return map(self.__getitem__, range(len(self)))

    def __getitem__(self, index: int) -> CGP:
        """
        Return a copy of an agent as an ordinary CGP, which predicts, saves, loads and exports, without an environment.

        :param index: the agent's index
        :return: the agent
        :raises IndexError: if there is no such agent
        """
        return self.agent(index)

    def agent(self, index: int, env: GymEnv | None = None) -> CGP:
        """
        Return a copy of an agent as an ordinary CGP.

        :param index: the agent's index
        :param env: an environment to go on training in by ``learn(..., reset_num_timesteps=False)``. The agent then also has a
            copy of its transitions.
        :return: the agent
        :raises IndexError: if there is no such agent
        """
        index = range(len(self))[operator.index(index)]
        agent = self._make_agent(index)
        if env is not None:
            agent.set_env(env)
            if self.replay_buffer is not None:
                agent.replay_buffer = copied_column(self.replay_buffer, index)
        return agent

    def _make_agent(self, index: int) -> CGP:
        spaces = self.observation_space, self.action_space
        with preserved_random_state(self.device):
            agent = make_agent(self.policy_class, self.agents[index], *spaces, self.device)  # type: ignore[arg-type]
        # First: to a model that has not learnt, trained critics without a trained actor would be somebody else's
        agent._n_updates = int(self._agent_updates[index])
        self.policy.copy_to(agent, index)
        # A copy, whose attributes may be set. Not a deep one, as selectors may refer to what cannot be copied.
        agent.policy.selector = copy.copy(self.policy.selector)
        agent.num_timesteps = self.num_timesteps // len(self)
        agent._current_progress_remaining = self._current_progress_remaining
        is_online = self._trains_online and agent._n_updates >= agent.policy_delay
        agent._policy_is_trained = is_online or bool(self._policies_trained[index])
        agent._policy_is_due = bool(self._policies_due[index])
        agent._choose_inference()
        return agent

    def learn(self: SelfMembers, *args: Any, **kwargs: Any) -> SelfMembers:
        """
        Learn, and train the actors that are due offline at the end.

        :param args: the arguments of SB3's method
        :param kwargs: the same arguments by keyword
        :return: the trained population
        :raises ValueError: if all agents have failed
        """
        super().learn(*args, **kwargs)
        self._report_failures()
        # A loaded population has no transitions if a callback stopped `learn` at its first step
        if self.replay_buffer is not None and self.replay_buffer.size() > 0:
            self._train_policies()
            self._report_failures()
        return self

    def _train_policies(self) -> None:
        """Train the actors that are due offline."""
        for index in sorted(set(np.flatnonzero(self._policies_due).tolist()) - set(self.failed)):
            self._train_policy(index)

    def _train_policy(self, index: int) -> bool:
        """Train an actor offline by its own CGP, and return whether it has not failed."""
        agent = self._make_agent(index)
        assert self.replay_buffer is not None
        agent.replay_buffer = copied_column(self.replay_buffer, index)
        # The axis of the log continues after the steps of all environments
        agent.num_timesteps = self.num_timesteps
        agent.set_logger(AgentLogger(self.logger, index))
        # A population logs none of its agents'
        agent.diagnostics = False
        try:
            self.policy.copy_actor_from(agent.train_policy(), index)
        except ValueError as error:
            # Of a loss that is NaN or infinite
            self._note_failure(index, str(error))
            return False
        self._policies_trained[index], self._policies_due[index] = True, False
        self._choose_inference()
        return True
