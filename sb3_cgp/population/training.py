"""The training of a population: acting, gradient steps, failures and the log, within SB3's loop."""

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import Schedule

from sb3_cgp.fast.cuda_graphs import RecordedFunction, Tensors, has_cuda_graphs
from sb3_cgp.fast.recorded_optimizers import CHECK_INTERVAL, LOSSES
from sb3_cgp.fast.replay_algorithm import LeanReplayAlgorithm
from sb3_cgp.guards.algorithm import GuardedAlgorithm
from sb3_cgp.population.arguments import Arguments, value_of
from sb3_cgp.population.gradient_step import AgentNumbers, GradientStep
from sb3_cgp.population.policies import PopulationPolicy, SelectFunction
from sb3_cgp.population.replay import sample_columns


class PopulationTraining(GuardedAlgorithm, LeanReplayAlgorithm):
    """
    The part of :class:`~sb3_cgp.population.algorithm.Population` that trains: what an agent does in ``core/cgp.py``, for all.
    """

    policy: PopulationPolicy
    # The arguments of each agent
    agents: list[Arguments]
    # Why an agent has failed
    _failures: list[str | None]
    # Gradient steps of each agent
    _agent_updates: np.ndarray
    # Whether each agent's actor has been trained offline, and whether its critics have learnt since then
    _policies_trained: np.ndarray
    _policies_due: np.ndarray
    # The critics' and the actors' learning rates of each agent
    _schedules: list[tuple[Schedule, Schedule]]
    _numbers: AgentNumbers
    # Arguments that count steps, by their names, (N,)
    _counts: dict[str, np.ndarray]
    # CUDA graphs by what is fixed when they are recorded, which includes what some agent is due to do
    _recorded: dict[tuple[Any, ...], RecordedFunction]
    # The last results of gradient steps by their keys in the log, (N,), until they are logged
    _unlogged: dict[str, th.Tensor]

    @property
    def _policy_loss(self) -> str | None:
        return value_of("policy_loss", self.agents[0])

    @property
    def _trains_online(self) -> bool:
        return self._policy_loss is not None and value_of("policy_training", self.agents[0]) == "online"

    @property
    def _trains_offline(self) -> bool:
        return self._policy_loss is not None and not self._trains_online

    def _choose_inference(self) -> None:
        """Let ``predict`` use the network that the user chose, or the selector for agents whose actor is not trained."""
        has_actor = self._policies_trained | self._trains_online
        self.policy.inference = (self.agents[0].get("inference") or "actor") if has_actor.any() else "cem"
        self.policy.set_actors(has_actor)

    @property
    def failed(self) -> dict[int, str]:
        """The agents whose training has failed, and why. Their parameters do not change any more."""
        return {index: reason for index, reason in enumerate(self._failures) if reason is not None}

    def _try_networks(self) -> None:
        """Do nothing: the agents have tried their networks one by one."""

    def _learning_starts_of_agents(self) -> list[int]:
        return [int(number) for number in self._counts["learning_starts"]]

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        # As SB3 does, with a warm-up of each agent's own
        is_random = self.num_timesteps // n_envs < self._counts["learning_starts"]
        actions = np.zeros((n_envs, *(self.action_space.shape or ())), dtype=self.action_space.dtype)
        if is_random.any():
            actions[:] = [self.action_space.sample() for _ in range(n_envs)]
        if not is_random.all():
            assert self._last_obs is not None
            self.policy.recorded_selection = self._select_actions
            try:
                with self.policy.acting_by("cem"):
                    selected, _ = self.predict(self._last_obs)
            finally:
                self.policy.recorded_selection = None
            actions[~is_random] = selected[~is_random]
        scaled = self.policy.scale_action(actions)
        if action_noise is not None:
            scaled = np.clip(scaled + action_noise(), -1, 1)
        return self.policy.unscale_action(scaled), scaled

    def train(self, gradient_steps: int, batch_size: int = 128) -> None:
        """
        Do gradient steps with all agents that have begun to learn and have not failed.

        :param gradient_steps: number of gradient steps
        :param batch_size: number of transitions in an agent's minibatch
        :raises ValueError: if all agents have failed
        """
        assert self.replay_buffer is not None
        if self.gradient_steps < 0:
            # As many as steps in one environment
            gradient_steps //= self.n_envs
        self.policy.set_training_mode(True)
        self._update_learning_rates()
        learns = self.num_timesteps // self.n_envs > self._counts["learning_starts"]
        learns &= np.array([failure is None for failure in self._failures])
        # Until its offline training, as in a CGP alone
        outdated = learns & self._trains_offline
        self._policies_due |= outdated
        if (self._policies_trained & outdated).any():
            self._policies_trained &= ~outdated
            self._choose_inference()
        n_updates_before = self._n_updates
        for _ in range(gradient_steps):
            self._n_updates += 1
            self._agent_updates += learns
            is_due = [self._agent_updates % self._counts[name] == 0 for name in ("policy_delay", "target_update_interval")]
            trains_actor, moves_averages = (each & learns for each in is_due)
            trains_actor &= self._trains_online
            due = th.from_numpy(np.stack([self._agent_updates, learns, trains_actor, moves_averages]))
            batch = sample_columns(self.replay_buffer, batch_size, self._numbers.gammas)
            inputs = (*batch, due.to(self.device, non_blocking=True))
            results = self._carry_out((bool(trains_actor.any()), bool(moves_averages.any())), inputs)
            # Without an actor that is due, there is no new loss of the actors
            self._unlogged |= {name: losses for name, losses in zip(LOSSES, results, strict=True) if losses is not None}
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        interval = CHECK_INTERVAL if self.device.type == "cuda" else 1
        if self._n_updates // interval > n_updates_before // interval:
            self._report_failures()

    def _update_learning_rates(self) -> None:
        """Set the agents' learning rates by their schedules, and log their means."""
        rates = np.array([[schedule(self._current_progress_remaining) for schedule in each] for each in self._schedules])
        optimizers = (self.policy.critic_optimizer, self.policy.actor_optimizer)
        for name, optimizer, own in zip(("learning_rate", "actor_learning_rate"), optimizers, rates.T, strict=True):
            self.logger.record(f"train/{name}", own.mean())
            optimizer.rates.copy_(th.from_numpy(own).view(-1, 1, 1), non_blocking=True)

    def _carry_out(self, due: tuple[bool, bool], inputs: Sequence[th.Tensor]) -> Tensors:
        """Carry a gradient step out, as a CUDA graph where possible: one for each combination of what is due."""
        step = GradientStep(self.policy, self._numbers, self._policy_loss, *due)
        if not self._records_steps:
            return step(*inputs)
        return self._recorded_function(due, lambda: [*self.policy.parameters(), *self.policy.buffers()])(step, *inputs)

    def _select_actions(self, select: SelectFunction, observation: th.Tensor) -> th.Tensor:
        """Select actions in a rollout, as a CUDA graph where possible."""
        if not self._records_steps:
            return select(observation)
        # Selecting actions changes no tensor
        (actions,) = self._recorded_function(None, list)(lambda observation: (select(observation),), observation)
        assert actions is not None
        return actions

    @property
    def _records_steps(self) -> bool:
        return self.cuda_graphs and has_cuda_graphs(self.device)

    def _recorded_function(
        self, due: tuple[bool, bool] | None, list_state: Callable[[], Sequence[th.Tensor]]
    ) -> RecordedFunction:
        """Return the recorded function of a gradient step, or of acting, None; a new one for another selector."""
        fixed = (due, repr(self.policy.selector), self.policy.has_actor)
        if fixed not in self._recorded:
            self._recorded[fixed] = RecordedFunction(list_state)
        return self._recorded[fixed]

    def _report_failures(self) -> None:
        """
        Read on the host which agents have failed, and warn of the new ones.

        :raises ValueError: if all agents have failed
        """
        for name, steps in zip(("critic", "actor"), self.policy.failed_at.tolist(), strict=True):
            for index, step in enumerate(steps):
                if step >= 0 and self._failures[index] is None:
                    self._agent_updates[index] = step
                    reason = f"The {name} loss was NaN or infinite at gradient step {step}. The {name} is as before that step."
                    self._note_failure(index, reason)
        if None not in self._failures:
            raise ValueError(f"All agents have failed. Agent {len(self._failures) - 1}: {self._failures[-1]}")

    def _note_failure(self, index: int, reason: str) -> None:
        """Note why an agent has failed, and warn of it."""
        self._failures[index] = reason
        others = " The other agents go on." if None in self._failures else ""
        warnings.warn(f"Agent {index} has failed. {reason}{others}", stacklevel=2)

    def _record_losses(self) -> None:
        """Log the means of the last losses over the agents that learn."""
        counts = self._agent_updates > 0
        counts &= np.array([failure is None for failure in self._failures])
        for name, values in self._unlogged.items():
            if counts.any():
                self.logger.record(f"train/{name}", float(values.numpy(force=True)[counts].mean()))
        self.logger.record("train/failed_agents", len(self.failed))
        self._unlogged = {}

    def dump_logs(self) -> None:
        """Write log data."""
        self._record_losses()
        super().dump_logs()

    def _before_saving_state(self) -> None:
        # Failures and the log are part of a saved state
        self._report_failures()
        self._record_losses()
