"""Cross-Entropy Guided Policies: the arguments, acting, and training in the order of the paper's Algorithm 2."""

import warnings
from collections import defaultdict
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy, ContinuousCritic
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, ReplayBufferSamples, Schedule
from stable_baselines3.common.utils import update_learning_rate
from stable_baselines3.td3.policies import Actor
from torch.nn import functional as F

from sb3_cgp.common.networks import update_average
from sb3_cgp.common.offline_training import rollout_locals, start_training
from sb3_cgp.common.rules import require, require_count
from sb3_cgp.common.sb3_arguments import as_schedule
from sb3_cgp.core import offline
from sb3_cgp.core.arguments import check_arguments
from sb3_cgp.core.cem import CEM, ActionSelector
from sb3_cgp.core.losses import POLICY_LOSSES
from sb3_cgp.core.policies import CGPPolicy, CnnPolicy, MlpPolicy, MultiInputPolicy

SelfCGP = TypeVar("SelfCGP", bound="CGP")


class CGP(OffPolicyAlgorithm):
    """
    Cross-Entropy Guided Policies (CGP), the paper's algorithm: the base of :class:`sb3_cgp.CGP`.

    Learn Q-functions by TD3's objective, with actions of the Cross-Entropy Method (CEM), and an actor that imitates CEM.

    Paper: https://arxiv.org/abs/1903.10605 (Algorithms 1 and 2). Arguments not listed are those of ``OffPolicyAlgorithm``.

    :param learning_rate: learning rate of the critics: a number, a function of the progress remaining (from 1 to 0), or a
        string such as ``"lin_1e-3"`` for a linear schedule that ends at 0
    :param learning_starts: number of random steps before learning starts; with few, some seeds fail (Appendix A)
    :param batch_size: number of transitions in a minibatch, b
    :param cem_iterations: number of CEM's iterations
    :param cem_samples: number of actions that CEM samples per state and iteration
    :param cem_elites: number of best samples to which CEM's next iteration is fitted, at most ``cem_samples``
    :param cem_result: "best" acts by the best sample of the last iteration (the paper), "mean" by the elites' mean
    :param policy_loss: the actor's loss: "cgp" imitates CEM, "qgp" follows the critic's gradient, None leaves acting to CEM
    :param policy_training: "online" trains the actor along with the critics, "offline" at the end of ``learn``
    :param inference: what ``predict`` uses: the "actor", the "averaged_actor" (φ' of Algorithm 2) or "cem". None stands for
        the actor. Rollouts always use CEM, and so does ``predict`` where no actor is trained.
    :param actor_learning_rate: learning rate of the actor, in the same forms. None stands for ``learning_rate``.
    :param policy_delay: The actor is updated once every ``policy_delay`` gradient steps
    :param target_update_interval: number of gradient steps between two updates of the target critics and the averaged actor
    :param target_policy_noise: Standard deviation of Gaussian noise added to target actions (smoothing noise)
    :param target_noise_clip: Limit for absolute value of target policy smoothing noise.
    :param kwargs: the further arguments of SB3's ``OffPolicyAlgorithm``. A ``selector`` in ``policy_kwargs`` replaces CEM.
    :raises ValueError: if an argument is out of its range or contradicts another one
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }
    policy: CGPPolicy
    actor: Actor
    critic: ContinuousCritic

    def __init__(
        self,
        policy: str | type[CGPPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule | str = 1e-3,
        *,
        learning_starts: int = 10_000,
        batch_size: int = 128,
        cem_iterations: int = 2,
        cem_samples: int = 64,
        cem_elites: int = 6,
        cem_result: str = "best",
        policy_loss: str | None = "cgp",
        policy_training: str = "online",
        inference: str | None = None,
        actor_learning_rate: float | Schedule | str | None = None,
        policy_delay: int = 1,
        target_update_interval: int = 2,
        target_policy_noise: float = 0.2,
        target_noise_clip: float = 0.5,
        _init_setup_model: bool = True,
        **kwargs: Any,
    ):
        super().__init__(
            policy,
            env,
            learning_rate,  # type: ignore[arg-type]  # `_setup_lr_schedule` converts a string
            learning_starts=learning_starts,
            batch_size=batch_size,
            support_multi_env=True,
            sde_support=False,
            **kwargs,
        )
        self.cem_iterations = cem_iterations
        self.cem_samples = cem_samples
        self.cem_elites = cem_elites
        self.cem_result = cem_result
        self.policy_loss = policy_loss
        self.policy_training = policy_training
        self.inference = inference
        self.actor_learning_rate = actor_learning_rate
        self.policy_delay = policy_delay
        self.target_update_interval = target_update_interval
        self.target_policy_noise = target_policy_noise
        self.target_noise_clip = target_noise_clip
        # Whether the actor has been trained, online, or offline after the critics
        self._policy_is_trained = False
        # Whether the critics have learnt since the last offline training of the policy
        self._policy_is_due = False
        if _init_setup_model:
            self._setup_model()

    def _setup_lr_schedule(self) -> None:
        self.lr_schedule = as_schedule(self.learning_rate)

    @property
    def actor_lr_schedule(self) -> Schedule:
        """The actor's learning rate as a function of the progress remaining: its own, or the critics'."""
        return self.lr_schedule if self.actor_learning_rate is None else as_schedule(self.actor_learning_rate)

    def _setup_model(self) -> None:
        # Not in the constructor: `load` sets the saved arguments after it, and calls this method then
        self._check_arguments()
        allowed = "a subclass of sb3_cgp.CGPPolicy. A saved model of another algorithm is loaded by that one's class"
        require(issubclass(self.policy_class, CGPPolicy), "policy", self.policy_class, allowed)
        super()._setup_model()
        self.actor, self.actor_target = self.policy.actor, self.policy.actor_target
        self.critic, self.critic_target = self.policy.critic, self.policy.critic_target
        if self.policy.selector is None:
            self.policy.selector = self._make_selector()
        self._choose_inference()

    def _check_arguments(self) -> None:
        check_arguments(self, tuple(POLICY_LOSSES))

    def _make_selector(self) -> ActionSelector:
        return CEM(self.cem_iterations, self.cem_samples, self.cem_elites, self.cem_result)

    def _choose_inference(self) -> None:
        """Let ``predict`` use the network that the user chose, or CEM while no actor is trained."""
        self.policy.inference = (self.inference or "actor") if self._has_actor else "cem"

    @property
    def _has_actor(self) -> bool:
        # Online there is an actor from the first step, except in a model whose critics have learnt without it before
        learns_along = self._trains_online and self._n_updates <= self.policy_delay
        return self.policy_loss is not None and (self._policy_is_trained or learns_along)

    def _mark_policy(self, is_trained: bool, is_due: bool = False) -> None:
        had_actor, self._policy_is_trained, self._policy_is_due = self._has_actor, is_trained, is_due
        if self._has_actor != had_actor:
            self._choose_inference()

    @property
    def _trains_online(self) -> bool:
        return self.policy_loss is not None and self.policy_training == "online"

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        # SB3 selects rollout actions by `predict`, which uses the actor for the user and the callbacks
        with self.policy.acting_by("cem"):
            return super()._sample_action(learning_starts, action_noise, n_envs)

    def train(self, gradient_steps: int, batch_size: int = 128) -> None:
        """
        Update the critics, the actor and their averages ("Train on replay buffer" of Algorithm 2).

        :param gradient_steps: number of gradient steps
        :param batch_size: number of transitions in a minibatch, b
        """
        assert self.replay_buffer is not None
        self.policy.set_training_mode(True)
        self._update_learning_rates(self._current_progress_remaining, "critic", "actor")
        self._mark_policy(self._policy_is_trained and self._trains_online, is_due=self.policy_training == "offline")

        values = defaultdict(list)
        for _ in range(gradient_steps):
            self._n_updates += 1
            batch = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
            trains_actor = self._trains_online and self._n_updates % self.policy_delay == 0
            moves_averages = self._n_updates % self.target_update_interval == 0
            for name, value in self._gradient_step(batch, trains_actor, moves_averages).items():
                values[name].append(value)
            if trains_actor:
                self._mark_policy(is_trained=True)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self._record_means(values)

    def _gradient_step(self, batch: ReplayBufferSamples, trains_actor: bool, moves_averages: bool) -> dict[str, th.Tensor]:
        """Update the critics on a minibatch, and the actor and the averages if they are due. Return what is to be logged."""
        # For n-step replay, discount factor is gamma**n_steps (when no early termination)
        discounts = batch.discounts if batch.discounts is not None else self.gamma
        with th.no_grad():
            # Select next actions by CEM on the first target critic
            next_actions = self.policy.select_actions(batch.next_observations, self.critic_target).actions
            # Smooth them by clipped noise, as TD3 does
            noise = th.empty_like(next_actions).normal_(0, self.target_policy_noise)
            noise = noise.clamp(-self.target_noise_clip, self.target_noise_clip)
            next_actions = (next_actions + noise).clamp(-1, 1)
            # Compute the target q*: min over all target critics
            next_q_values = th.cat(self.critic_target(batch.next_observations, next_actions), dim=1)
            next_q_values = next_q_values.min(dim=1, keepdim=True).values
            target_q_values = batch.rewards + (1 - batch.dones) * discounts * next_q_values

        # Update the critics
        current_q_values = self.critic(batch.observations, batch.actions)
        critic_loss = th.stack([F.mse_loss(q_values, target_q_values) for q_values in current_q_values]).sum()
        self._descend("critic", critic_loss)
        values = {"critic_loss": critic_loss.detach(), "q_value": current_q_values[0].detach().mean()}

        # Update the policy: as in TD3, its loss sees the updated critic
        if trains_actor:
            assert self.policy_loss is not None
            actor_loss = POLICY_LOSSES[self.policy_loss](self.policy, batch.observations)
            self._descend("actor", actor_loss)
            values["actor_loss"] = actor_loss.detach()

        # Update the target critics and the averaged actor, every second step by default (Appendix B)
        if moves_averages:
            update_average(self.critic, self.critic_target, self.tau)
            update_average(self.actor, self.actor_target, self.tau)
        return values

    def _update_learning_rates(self, progress_remaining: float, *names: str) -> None:
        """Set the learning rates of the "critic" or the "actor" by their schedules."""
        for name in names:
            schedule = self.actor_lr_schedule if name == "actor" else self.lr_schedule
            rate = schedule(progress_remaining)
            self.logger.record("train/actor_learning_rate" if name == "actor" else "train/learning_rate", rate)
            update_learning_rate(getattr(self, name).optimizer, rate)

    def _descend(self, name: str, loss: th.Tensor) -> None:
        """Take one step of the optimizer of the "critic" or the "actor" down a loss."""
        self._check_loss(name, loss)
        # The user may have frozen the actor, by `requires_grad_(False)`; TD3's loss of the actor has a gradient even so
        if loss.requires_grad or name != "actor":
            optimizer = getattr(self, name).optimizer
            optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimizer.step()

    def _check_loss(self, name: str, loss: th.Tensor) -> None:
        """Do what is to be done before an optimizer step; subclasses override this."""

    def _record_means(self, values: dict[str, list[th.Tensor]]) -> None:
        """Log the means of scalars over gradient steps, given by their keys in the log without "train/"."""
        for name, scalars in values.items():
            self.logger.record(f"train/{name}", th.stack(scalars).mean().item())

    def learn(
        self: SelfCGP,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "CGP",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfCGP:
        """Learn as SB3's algorithms do, and train the policy at the end if its training is offline (:meth:`train_policy`)."""
        super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
        # Only if the critics have changed, and there is data: a callback may have stopped `learn` at its first step
        is_due = self._policy_is_due and self.policy_training == "offline"
        if is_due and self.replay_buffer is not None and self.replay_buffer.size() > 0:
            self.train_policy(callback=callback, progress_bar=progress_bar)
        return self

    def train_policy(
        self: SelfCGP,
        max_steps: int = 100_000,
        batch_size: int | None = None,
        callback: MaybeCallback = None,
        progress_bar: bool = False,
    ) -> SelfCGP:
        """
        Train the policy to convergence on the critics and the replay buffer as they are (the paper's offline training).

        The parameters and the convergence rule are described at :meth:`sb3_cgp.CGP.train_policy`.
        """
        batch_size = self.batch_size if batch_size is None else batch_size
        self._check_policy_training(max_steps, batch_size)
        is_trained, is_due = self._policy_is_trained, self._policy_is_due
        # Callbacks evaluate and save the actor that is being trained
        self._mark_policy(is_trained=True, is_due=is_due)
        try:
            callback = start_training(self, callback, max_steps, progress_bar)
            n_steps, is_due = self._descend_to_plateau(max_steps, batch_size, callback)
            # An actor that a callback stopped within its first round is of no use
            is_trained = is_trained or n_steps >= min(offline.ROUND, max_steps)
            if is_due:
                acts = "the actor" if is_trained else "CEM"
                warnings.warn(f"A callback stopped the policy's training after {n_steps} steps: {acts} acts.", stacklevel=2)
        finally:
            self._mark_policy(is_trained, is_due)
        callback.on_training_end()
        if self.verbose >= 1:
            print(f"The policy was trained for {n_steps} gradient steps")
        return self

    def _check_policy_training(self, max_steps: int, batch_size: int) -> None:
        require_count("max_steps", max_steps)
        allowed = f"one of {', '.join(map(repr, POLICY_LOSSES))} to train a policy"
        require(self.policy_loss is not None, "policy_loss", self.policy_loss, allowed)
        allowed = "False to train a policy apart: a shared extractor would change the critics"
        require(not self.policy.share_features_extractor, "share_features_extractor", True, allowed)
        require_count("batch_size", batch_size)
        is_filled = self.replay_buffer is not None and self.replay_buffer.size() > 0
        require(is_filled, "replay_buffer", self.replay_buffer, "filled, by `learn` or `load_replay_buffer`")

    def _descend_to_plateau(self, max_steps: int, batch_size: int, callback: BaseCallback) -> tuple[int, bool]:
        """Train the actor until its loss no longer falls; return the number of steps, and whether a callback stopped it."""
        assert self.replay_buffer is not None and self.policy_loss is not None  # noqa: PT018
        losses, means = [], []
        for n_steps in range(1, max_steps + 1):
            # Callbacks may have evaluated the policy. Batch norm of the critics keeps its statistics.
            self.policy.set_training_mode(True)
            self.critic.set_training_mode(False)
            self._update_learning_rates(1.0 - (n_steps - 1) / max_steps, "actor")
            observations = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env).observations
            loss = POLICY_LOSSES[self.policy_loss](self.policy, observations)
            self._descend("actor", loss)
            losses.append(loss.detach())
            if n_steps % self.target_update_interval == 0:
                update_average(self.actor, self.actor_target, self.tau)
            callback.update_locals(rollout_locals(self, callback))
            if not callback.on_step():
                return n_steps, True
            if n_steps % offline.ROUND == 0:
                self._record_round(losses)
                # The log's axis continues after the environment steps
                self.logger.dump(self.num_timesteps + n_steps)
                means.append(th.stack(losses).mean().item())
                if offline.has_plateaued(means):
                    return n_steps, False
                losses = []
        warnings.warn(f"The policy's loss has not reached a plateau in max_steps={max_steps} steps.", stacklevel=3)
        return max_steps, False

    def _record_round(self, losses: list[th.Tensor]) -> None:
        """Log the mean loss of a round of offline training."""
        self._record_means({"actor_loss": losses})

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "actor", "actor_target", "critic", "critic_target"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "actor.optimizer", "critic.optimizer"], []
