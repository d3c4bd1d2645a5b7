"""CGP whose gradient steps, and whose acting by CEM, are CUDA graphs on a GPU."""

import functools
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from sb3_cgp.common.rules import require
from sb3_cgp.common.transient import TransientAttributes
from sb3_cgp.core.cgp import CGP
from sb3_cgp.fast.cuda_graphs import RecordedFunction, Tensors, has_cuda_graphs
from sb3_cgp.fast.recorded_optimizers import CHECK_INTERVAL, LOSSES, LossWatch, is_fused_adam, set_capturable, skip_step_if

SelfCudaGraphAlgorithm = TypeVar("SelfCudaGraphAlgorithm", bound="CudaGraphAlgorithm")


class CudaGraphAlgorithm(TransientAttributes, CGP):
    """
    CGP whose gradient steps are recorded as CUDA graphs on a GPU, and replayed.

    The recorded function is the core's gradient step itself, on a minibatch that was sampled before. Its losses are read when
    the log is written, as reading them at every step would make the host wait for the GPU. The optimizer skips a step whose
    loss is NaN or infinite; the error follows when the log is written. Without a GPU, and with ``Dict`` observations or
    another optimizer than a fused Adam, steps are carried out as usual.
    """

    # Graphs, and tensors on the device, which are made anew for a copied or loaded model
    TRANSIENT: ClassVar[tuple[str, ...]] = (
        "_records_steps",
        "_recorded_rates",
        "_recorded",
        "_recorded_settings",
        "_loss_watch",
        "_unlogged",
        "_watches_losses",
    )
    # The argument of the constructor
    cuda_graphs: bool = True

    def _setup_model(self) -> None:
        require(isinstance(self.cuda_graphs, bool), "cuda_graphs", self.cuda_graphs, "True or False")
        super()._setup_model()
        self._prepare_graphs()

    def _prepare_graphs(self) -> None:
        """Decide whether gradient steps are recorded, and discard the present graphs."""
        optimizers = (self.actor.optimizer, self.critic.optimizer)
        self._records_steps = (
            self.cuda_graphs
            and has_cuda_graphs(self.device)
            and isinstance(self.observation_space, spaces.Box)
            and all(map(is_fused_adam, optimizers))
        )
        # Tensors from which graphs read the learning rates
        self._recorded_rates: dict[str, th.Tensor] = {}
        for name, optimizer in zip(("actor", "critic"), optimizers, strict=True):
            if self._records_steps:
                self._recorded_rates[name] = th.tensor(float(optimizer.param_groups[0]["lr"]), device=self.device)
            set_capturable(optimizer, self._recorded_rates.get(name))
        # By (trains the actor, moves the averages); None for acting
        self._recorded: dict[tuple[bool, bool] | None, RecordedFunction] = {}
        self._recorded_settings: tuple[Any, ...] = ()
        self._loss_watch = LossWatch(("critic", "actor"), self._n_updates, self.device)
        self._unlogged: dict[str, list[th.Tensor]] = {}
        # Whether losses are watched on the device, as within `_carry_out`
        self._watches_losses = False

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
        # The optimizers' state is in other memory now
        self._prepare_graphs()

    def train(self, gradient_steps: int, batch_size: int = 128) -> None:
        """
        Do gradient steps, as CUDA graphs where possible.

        :param gradient_steps: number of gradient steps
        :param batch_size: number of transitions in a minibatch
        :raises ValueError: if a loss was NaN or infinite
        """
        n_updates_before = self._n_updates
        super().train(gradient_steps, batch_size)
        if self._records_steps and self._n_updates // CHECK_INTERVAL > n_updates_before // CHECK_INTERVAL:
            self._loss_watch.check()

    def _gradient_step(self, batch: ReplayBufferSamples, trains_actor: bool, moves_averages: bool) -> dict[str, th.Tensor]:
        if not self._records_steps:
            return super()._gradient_step(batch, trains_actor, moves_averages)
        due = (trains_actor, moves_averages)
        results = self._recorded_function(due)(functools.partial(self._carry_out, due), *batch)
        return {name: loss for name, loss in zip(LOSSES, results, strict=True) if loss is not None}

    def _carry_out(self, due: tuple[bool, bool], *fields: th.Tensor) -> Tensors:
        """Carry the core's gradient step out on a minibatch, and return its losses."""
        self._loss_watch.begin_step()
        self._watches_losses = True
        try:
            losses = super()._gradient_step(ReplayBufferSamples(*fields), *due)
        finally:
            self._watches_losses = False
        return tuple(losses.get(name) for name in LOSSES)

    def _recorded_function(self, due: tuple[bool, bool] | None) -> RecordedFunction:
        """Return the recorded function of a gradient step or of acting; a new one if a setting has changed."""
        selector = self.policy.selector
        noise = (self.target_policy_noise, self.target_noise_clip)
        policy = (getattr(self.policy, "cem_dtype", None), getattr(self.policy, "actor_proposes", None))
        # What a graph fixes when it is recorded, and a callback may change
        step = (self.gamma, self.tau, self.batch_size, *noise, self.policy_loss, *self._optimizer_settings())
        settings = (*step, *policy, selector, repr(selector))
        if settings != self._recorded_settings:
            self._recorded.clear()
            self._recorded_settings = settings
        if due not in self._recorded:
            # Selecting actions changes no tensor
            self._recorded[due] = RecordedFunction() if due is None else RecordedFunction(self._list_state)
        return self._recorded[due]

    def _optimizer_settings(self) -> tuple[str, list[bool]]:
        """
        Return the options of the optimizers but the learning rates, which are tensors that a graph reads, and which of their
        parameters are trained. Their lists are read at every step, as walking through the networks takes ten times as long.
        """
        groups = [*self.actor.optimizer.param_groups, *self.critic.optimizer.param_groups]
        options = str([{key: value for key, value in group.items() if key not in ("params", "lr")} for group in groups])
        return options, [parameter.requires_grad for group in groups for parameter in group["params"]]

    def _list_state(self) -> list[th.Tensor]:
        """Return the tensors that a gradient step changes in place."""
        moments = [
            value
            for optimizer in (self.actor.optimizer, self.critic.optimizer)
            for state in optimizer.state.values()
            for value in state.values()
        ]
        return [*self.policy.parameters(), *self.policy.buffers(), *moments, *self._loss_watch.state]

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        if not self._records_steps:
            return super()._sample_action(learning_starts, action_noise, n_envs)
        self.policy.recorded_selection = self._select_actions  # type: ignore[assignment]
        try:
            return super()._sample_action(learning_starts, action_noise, n_envs)
        finally:
            self.policy.recorded_selection = None  # type: ignore[assignment]

    def _select_actions(self, observation: th.Tensor) -> Tensors:
        """Select actions in rollouts, as a CUDA graph."""
        return self._recorded_function(None)(
            lambda observation: self.policy.select_actions(observation, self.critic), observation
        )

    def _update_learning_rates(self, progress_remaining: float, *names: str) -> None:
        super()._update_learning_rates(progress_remaining, *names)
        for name in self._recorded_rates.keys() & set(names):
            for group in getattr(self, name).optimizer.param_groups:
                # SB3 has put a number in the place of the tensor that graphs read
                self._recorded_rates[name].fill_(group["lr"])
                group["lr"] = self._recorded_rates[name]

    def _check_loss(self, name: str, loss: th.Tensor) -> None:
        optimizer = getattr(self, name).optimizer
        if self._watches_losses:
            # Not the other checks, which would read the loss on the host
            skip_step_if(optimizer, self._loss_watch.see(name, loss))
        else:
            # Not recorded, as in the policy's offline training
            skip_step_if(optimizer, None)
            super()._check_loss(name, loss)

    def _record_means(self, values: dict[str, list[th.Tensor]]) -> None:
        if self._records_steps:
            # Until the log is written
            self._unlogged.update(values)
        else:
            super()._record_means(values)

    def _record_round(self, losses: list[th.Tensor]) -> None:
        super()._record_round(losses)
        self._report()

    def _report(self) -> None:
        """
        Log the losses of recorded steps, for which the host synchronises with the GPU.

        :raises ValueError: if a loss was NaN or infinite
        """
        if self._records_steps:
            self._loss_watch.check()
            unlogged, self._unlogged = self._unlogged, {}
            super()._record_means(unlogged)

    def dump_logs(self) -> None:
        """
        Write log data.

        :raises ValueError: if a loss was NaN or infinite in a recorded gradient step
        """
        self._report()
        super().dump_logs()

    def learn(self: SelfCudaGraphAlgorithm, *args: Any, **kwargs: Any) -> SelfCudaGraphAlgorithm:
        """
        Learn as the core does.

        :param args: the core's arguments
        :param kwargs: the core's arguments
        :return: the trained model
        :raises ValueError: if a loss was NaN or infinite
        """
        super().learn(*args, **kwargs)
        if self._records_steps:
            self._loss_watch.check()
        return self

    def _before_saving_state(self) -> None:
        # A state saved now has the losses in its log, and no NaN unreported
        self._report()

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        # Without `_init_setup_model` there are no networks yet
        if "actor" in state:
            self._prepare_graphs()
