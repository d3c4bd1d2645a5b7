"""Off-policy algorithms whose gradient steps are watched for NaN, and are CUDA graphs on a GPU."""

from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.td3.policies import Actor

from sb3_cgp.core.policies import CGPPolicy
from sb3_cgp.fast.cuda_graphs import (
    Captured,
    LossWatch,
    can_capture,
    is_fused_adam,
    set_capturable,
    set_learning_rate,
    skip_step_if,
)
from sb3_cgp.fast.replay import LeanReplayAlgorithm


class StepLosses(NamedTuple):
    """
    What a gradient step found, as scalars on the device.

    :param critic: the critics' loss
    :param q_value: the first critic's mean value
    :param actor: the actor's loss; None where it was not its turn
    """

    critic: th.Tensor
    q_value: th.Tensor
    actor: th.Tensor | None


class GradientAlgorithm(LeanReplayAlgorithm):
    """
    An algorithm that says what a gradient step is, and has it carried out here.

    On a GPU, where ``cuda_graphs`` says so, a step is recorded as a CUDA graph and replayed: what it finds is read only when
    it is logged. Elsewhere it is carried out as it stands.
    """

    policy: CGPPolicy
    actor: Actor
    critic: ContinuousCritic

    def _gradient_step(self, batch: ReplayBufferSamples, *turns: bool) -> StepLosses:
        """
        Do one gradient step.

        :param batch: a minibatch
        :param turns: what is due in this step, for the algorithm to tell
        :return: the losses
        """
        raise NotImplementedError

    def _fixed_in_graphs(self) -> tuple[Any, ...]:
        """List the settings that a graph fixes when it is recorded, and that a callback may change."""
        raise NotImplementedError

    def _prepare_capture(self) -> None:
        """Settle whether gradient steps are recorded as CUDA graphs, and forget those there are."""
        optimizers = (self.actor.optimizer, self.critic.optimizer)
        self._is_captured = (
            self.cuda_graphs
            and can_capture(self.device)
            and isinstance(self.observation_space, spaces.Box)
            and all(map(is_fused_adam, optimizers))
        )
        self._captured_rates: dict[th.optim.Optimizer, th.Tensor] = {}
        for optimizer in optimizers:
            if self._is_captured:
                self._captured_rates[optimizer] = th.tensor(float(optimizer.param_groups[0]["lr"]), device=self.device)
            set_capturable(optimizer, self._captured_rates.get(optimizer))
        # By what is due in a gradient step; None for acting
        self._captures: dict[tuple[bool, ...] | None, Captured] = {}
        self._captured_settings: tuple[Any, ...] = ()
        self._loss_watch = LossWatch(("critic", "actor"), self._n_updates, self.device)
        self._unlogged_losses: dict[str, list[th.Tensor]] = {}

    def _capture(self, turns: tuple[bool, ...] | None) -> Captured:
        """Find the capture of a gradient step or of acting, a new one if a setting has changed."""
        settings = self._fixed_in_graphs()
        if settings != self._captured_settings:
            self._captures.clear()
            self._captured_settings = settings
        if turns not in self._captures:
            # Selecting actions changes nothing
            self._captures[turns] = Captured() if turns is None else Captured(self._list_state)
        return self._captures[turns]

    def _list_state(self) -> list[th.Tensor]:
        """List the tensors that a gradient step changes in place."""
        moments = [
            value
            for optimizer in (self.actor.optimizer, self.critic.optimizer)
            for state in optimizer.state.values()
            for value in state.values()
        ]
        return [*self.policy.parameters(), *self.policy.buffers(), *moments, *self._loss_watch.state]

    def _select_actions(self, observation: th.Tensor) -> tuple[th.Tensor | None, ...]:
        """Select actions for acting while training, as a CUDA graph."""
        return self._capture(None)(lambda observation: self.policy.select_actions(observation, self.critic), observation)

    def set_parameters(
        self, load_path_or_dict: str | dict[str, Any], exact_match: bool = True, device: th.device | str = "auto"
    ) -> None:
        """
        Load parameters from a given zip-file or a nested dictionary containing parameters for different modules.

        :param load_path_or_dict: Location of the saved data (path or file-like, see ``save``), or a nested
            dictionary containing nn.Module parameters used by the policy.
        :param exact_match: If True, the given parameters should include parameters for each module and each of their
            parameters, otherwise raises an Exception.
        :param device: Device on which the code should run.
        """
        super().set_parameters(load_path_or_dict, exact_match, device)
        # The optimisers' state lies elsewhere in memory now
        self._prepare_capture()

    def _step_on(self, batch: ReplayBufferSamples, *turns: bool) -> StepLosses:
        """
        Carry a gradient step out, on a GPU as a CUDA graph.

        :param batch: a minibatch
        :param turns: what is due in this step
        :return: the losses
        """
        if not self._is_captured:
            return self._gradient_step(batch, *turns)

        def step(*fields: th.Tensor) -> StepLosses:
            self._loss_watch.begin_step()
            return self._gradient_step(ReplayBufferSamples(*fields), *turns)

        return StepLosses(*self._capture(turns)(step, *batch))  # type: ignore[arg-type]

    def _descend(self, optimizer: th.optim.Optimizer, loss: th.Tensor, name: str) -> th.Tensor:
        """
        Take one step down a loss, unless it is NaN or infinite.

        :param optimizer: the network's optimiser
        :param loss: the loss, a scalar
        :param name: the network's name, for the error
        :return: the loss, a scalar without gradient
        :raises ValueError: if the loss is NaN or infinite; where steps are captured, :class:`LossWatch` raises it later
        """
        if self._is_captured:
            skip_step_if(optimizer, self._loss_watch.see(name, loss))
        elif not np.isfinite(loss.item()):
            raise ValueError(
                f"The {name} loss is {loss.item()} at gradient step {self._n_updates}, environment step {self.num_timesteps}. "
                f"The {name} is as before that step."
            )
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        return loss.detach()

    def _update_learning_rate(self, optimizers: list[th.optim.Optimizer] | th.optim.Optimizer) -> None:
        # SB3's would put a number in a captured tensor's place
        rate = self.lr_schedule(self._current_progress_remaining)
        self.logger.record("train/learning_rate", rate)
        for optimizer in optimizers if isinstance(optimizers, list) else [optimizers]:
            set_learning_rate(optimizer, rate, self._captured_rates.get(optimizer))

    def _record_losses(self, losses: list[StepLosses]) -> None:
        """Log the means over some gradient steps; on a GPU when the log is written, as the host would have to wait for it."""
        for key, values in zip(
            ("train/critic_loss", "train/q_value", "train/actor_loss"), zip(*losses, strict=True), strict=False
        ):
            present = [value for value in values if value is not None]
            if len(present) > 0:
                self._unlogged_losses[key] = present
        if not self._is_captured:
            self._log_losses()

    def _log_losses(self) -> None:
        for key, values in self._unlogged_losses.items():
            self.logger.record(key, th.stack(values).mean().item())
        self._unlogged_losses.clear()

    def dump_logs(self) -> None:
        """
        Write log data.

        :raises ValueError: if a loss was NaN or infinite in a captured gradient step
        """
        if self._is_captured:
            self._loss_watch.check()
            self._log_losses()
        super().dump_logs()

    def _excluded_save_params(self) -> list[str]:
        captured = ["_is_captured", "_captured_rates", "_captures", "_captured_settings", "_loss_watch", "_unlogged_losses"]
        return [*super()._excluded_save_params(), *captured]
