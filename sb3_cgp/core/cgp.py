"""Cross-Entropy Guided Policies: the arguments, acting, and training in the order of the paper's Algorithm 2."""

from functools import partial
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy, ContinuousCritic
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, ReplayBufferSamples, Schedule
from stable_baselines3.common.utils import (
    FloatSchedule,
    LinearSchedule,
    configure_logger,
    polyak_update,
)
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.td3.policies import Actor

from sb3_cgp.common.rules import (
    LINEAR_SCHEDULE_PREFIX,
    check_action_space,
    check_cgp,
    check_finite,
    require,
    require_count,
)
from sb3_cgp.core.cem import CEM
from sb3_cgp.core.losses import bootstrap_target, cgp_loss, critic_loss, qgp_loss, smooth_target_actions
from sb3_cgp.core.offline import descend_to_plateau
from sb3_cgp.core.policies import CGPPolicy, CnnPolicy, MlpPolicy, MultiInputPolicy
from sb3_cgp.diagnostics import policy_diagnostics
from sb3_cgp.export.read import ExportedPolicy, load_weights
from sb3_cgp.export.write import export_policy
from sb3_cgp.fast.cuda_graph_algorithm import GradientAlgorithm, StepLosses
from sb3_cgp.fast.cuda_graphs import set_learning_rate
from sb3_cgp.guards.faults import BoundsWatch, check_reward, check_shape, guarded
from sb3_cgp.resumption.algorithm import ResumableAlgorithm

SelfCGP = TypeVar("SelfCGP", bound="CGP")

# Gradient steps between two looks at the policy, each of which costs a run of CEM
DIAGNOSTICS_INTERVAL = 100


def _as_schedule(rate: float | Schedule | str) -> Schedule:
    """Make a schedule of a learning rate in any of the forms that are allowed."""
    if isinstance(rate, str):
        return LinearSchedule(float(rate.removeprefix(LINEAR_SCHEDULE_PREFIX)), 0.0, 1.0)
    return FloatSchedule(rate)


def _running_statistics(network: th.nn.Module) -> list[th.Tensor]:
    """List batch norm's running statistics."""
    return [buffer for name, buffer in network.named_buffers() if "running_" in name]


class CGP(ResumableAlgorithm, GradientAlgorithm):
    """
    Cross-Entropy Guided Policies (CGP).

    Learns Q-functions by TD3's objective, with actions picked by the Cross-Entropy Method (CEM), and distils CEM into
    an actor that acts at inference for the price of one forward pass.

    Paper: https://arxiv.org/abs/1903.10605 (Algorithms 1 and 2; the defaults are Appendix B's)

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, ...)
    :param env: The environment to learn from (if registered in Gym, can be str)
    :param learning_rate: learning rate of the critics, and of the actor unless ``actor_learning_rate`` is given;
        it can be a function of the current progress remaining (from 1 to 0), or a string such as ``"lin_1e-3"`` that
        falls linearly to 0
    :param buffer_size: size of the replay buffer
    :param learning_starts: how many random steps to take before learning starts; with few, CGP often fails
        (the paper's Appendix A)
    :param batch_size: Minibatch size for each gradient update
    :param tau: the soft update coefficient of the targets and the averaged actor ("Polyak update", between 0 and 1)
    :param gamma: the discount factor
    :param train_freq: Update the model every ``train_freq`` steps. Alternatively pass a tuple of frequency and unit
        like ``(5, "step")`` or ``(2, "episode")``.
    :param gradient_steps: How many gradient steps to do after each rollout (see ``train_freq``)
        Set to ``-1`` means to do as many gradient steps as steps done in the environment during the rollout.
    :param action_noise: the action noise type (None by default): CEM explores by its own sampling
    :param replay_buffer_class: Replay buffer class to use (for instance ``HerReplayBuffer``).
        If ``None``, it will be automatically selected.
    :param replay_buffer_kwargs: Keyword arguments to pass to the replay buffer on creation.
    :param optimize_memory_usage: Enable a memory efficient variant of the replay buffer at a cost of more complexity.
    :param n_steps: When n_step > 1, uses n-step return (with the NStepReplayBuffer) when updating the critics.
    :param cem_iterations: iterations of CEM
    :param cem_samples: actions that CEM samples per state and iteration
    :param cem_elites: best samples that CEM's next iteration is fitted to, at most ``cem_samples``
    :param cem_result: "best" acts by the best sample of the last iteration (the paper), "mean" by the elites' mean
    :param cem_dtype: what all layers of the critic but the last compute in while CEM asks it: "float32", "bfloat16", or
        "auto", which is bfloat16 on processors that multiply it natively. Values, actions and the critic's own training
        are float32 in any case.
    :param cuda_graphs: on a GPU, whether gradient steps and CEM's acting are recorded as CUDA graphs, and the replay buffer
        lies on the GPU, which is to compute the same in less time. What a selector of your own decides in Python is
        decided once, then. Has no effect on a CPU, nor with ``Dict`` observations or another optimiser than the
        fused Adam.
    :param policy_loss: what the actor learns from: "cgp" imitates CEM, "qgp" climbs the critic's gradient,
        None trains no actor, so that CEM acts at inference too
    :param policy_training: "online" trains the actor along with the critics, "offline" when ``learn`` has finished
        with them (see :meth:`train_policy`)
    :param inference: what ``predict`` asks: the "actor", the "averaged_actor" (φ' of Algorithm 2) or "cem".
        None stands for the actor, or for CEM where there is no ``policy_loss``. In any case, CEM acts while training,
        and offline until the policy is trained.
    :param actor_learning_rate: learning rate of the actor, in the same forms. None stands for ``learning_rate``.
    :param policy_delay: The actor is updated once every ``policy_delay`` gradient steps
    :param target_update_interval: The target critics and the averaged actor are updated once every
        ``target_update_interval`` gradient steps
    :param target_policy_noise: Standard deviation of Gaussian noise added to target actions (smoothing noise)
    :param target_noise_clip: Limit for absolute value of target policy smoothing noise.
    :param stats_window_size: Window size for the rollout logging, specifying the number of episodes to average
        the reported success rate, mean episode length, and mean reward over
    :param tensorboard_log: the log location for tensorboard (if None, no logging)
    :param policy_kwargs: additional arguments to be passed to the policy on creation,
        see :class:`~sb3_cgp.core.policies.CGPPolicy`; a ``selector`` among them takes the place of CEM
    :param verbose: Verbosity level: 0 for no output, 1 for info messages (such as device or wrappers used), 2 for
        debug messages
    :param seed: Seed for the pseudo random generators
    :param device: Device (cpu, cuda, ...) on which the code should be run.
        Setting it to auto, the code will be run on the GPU if possible.
    :param _init_setup_model: Whether or not to build the network at the creation of the instance
    :raises ValueError: if an argument is out of its range or contradicts another one
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }
    policy: CGPPolicy
    actor: Actor
    actor_target: Actor
    critic: ContinuousCritic
    critic_target: ContinuousCritic

    def __init__(
        self,
        policy: str | type[CGPPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule | str = 1e-3,
        buffer_size: int = 1_000_000,  # 1e6
        learning_starts: int = 10_000,
        batch_size: int = 128,
        tau: float = 0.005,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int = 1,
        action_noise: ActionNoise | None = None,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        n_steps: int = 1,
        cem_iterations: int = 2,
        cem_samples: int = 64,
        cem_elites: int = 6,
        cem_result: str = "best",
        cem_dtype: str = "auto",
        cuda_graphs: bool = True,
        policy_loss: str | None = "cgp",
        policy_training: str = "online",
        inference: str | None = None,
        actor_learning_rate: float | Schedule | str | None = None,
        policy_delay: int = 1,
        target_update_interval: int = 2,
        target_policy_noise: float = 0.2,
        target_noise_clip: float = 0.5,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ):
        super().__init__(
            policy,
            env,
            learning_rate,  # type: ignore[arg-type]  # a string is made a schedule in `_setup_lr_schedule`
            buffer_size,
            learning_starts,
            batch_size,
            tau,
            gamma,
            train_freq,
            gradient_steps,
            action_noise=action_noise,
            replay_buffer_class=replay_buffer_class,
            replay_buffer_kwargs=replay_buffer_kwargs,
            optimize_memory_usage=optimize_memory_usage,
            n_steps=n_steps,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            seed=seed,
            sde_support=False,
            support_multi_env=True,
        )

        self.cem_iterations = cem_iterations
        self.cem_samples = cem_samples
        self.cem_elites = cem_elites
        self.cem_result = cem_result
        self.cem_dtype = cem_dtype
        self.cuda_graphs = cuda_graphs
        self.policy_loss = policy_loss
        self.policy_training = policy_training
        self.inference: str | None = inference
        self.actor_learning_rate = actor_learning_rate
        self.policy_delay = policy_delay
        self.target_update_interval = target_update_interval
        self.target_policy_noise = target_policy_noise
        self.target_noise_clip = target_noise_clip
        # Offline, the actor is of no use until `train_policy` has trained it
        self._policy_is_trained = False
        # Whether the networks know only observations that VecNormalize has normalised
        self._learnt_normalized = False
        # Environment steps at the last call of `train`, to log the gradient steps per environment step
        self._timesteps_trained_at = 0

        if _init_setup_model:
            self._setup_model()

    @staticmethod
    def _wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        # The first place that sees every environment's action space, before SB3's assertions, which name no value
        env = GradientAlgorithm._wrap_env(env, verbose, monitor_wrapper)
        check_action_space(env.action_space)
        return env

    def _setup_lr_schedule(self) -> None:
        self.lr_schedule = _as_schedule(self.learning_rate)
        self._actor_lr_schedule = None if self.actor_learning_rate is None else _as_schedule(self.actor_learning_rate)

    @property
    def actor_lr_schedule(self) -> Schedule:
        """The actor's learning rate by progress remaining: its own, or the critics', as it is at the time."""
        return self.lr_schedule if self._actor_lr_schedule is None else self._actor_lr_schedule

    def _setup_model(self) -> None:
        # Here, as `load` bypasses the constructor
        if self.inference is None:
            self.inference = "cem" if self.policy_loss is None else "actor"
        check_cgp(self)
        require(issubclass(self.policy_class, CGPPolicy), "policy", self.policy_class, "a subclass of sb3_cgp.CGPPolicy")
        super()._setup_model()
        self._create_aliases()
        if self.policy_kwargs.get("selector") is None:
            self.policy.selector = CEM(self.cem_iterations, self.cem_samples, self.cem_elites, self.cem_result)
        self.policy.cem_dtype = self.cem_dtype
        self._choose_inference()
        self._prepare_capture()

    def _create_aliases(self) -> None:
        self.actor = self.policy.actor
        self.actor_target = self.policy.actor_target
        self.critic = self.policy.critic
        self.critic_target = self.policy.critic_target

    def _choose_inference(self) -> None:
        """Let ``predict`` ask what the user chose, or CEM while there is no trained actor."""
        assert self.inference is not None  # settled in `_setup_model`
        actor_is_trained = self.policy_training == "online" or self._policy_is_trained
        self.policy.inference = self.inference if actor_is_trained else "cem"

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, Any]:
        total_timesteps, callback = super()._setup_learn(*args, **kwargs)
        first_obs = self._last_obs if self._vec_normalize_env is None else self._last_original_obs
        assert first_obs is not None
        check_shape("observation", first_obs, self.observation_space, self.n_envs, self.num_timesteps)
        check_finite("observation", first_obs, self.num_timesteps)
        self._bounds_watch = BoundsWatch(self.observation_space)
        self._bounds_watch.check(first_obs, self.num_timesteps)
        self._learnt_normalized = self._vec_normalize_env is not None and self._vec_normalize_env.norm_obs
        self._timesteps_trained_at = max(self.num_timesteps, self.learning_starts)
        return total_timesteps, callback

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        # SB3's rollout asks `predict`, which answers the user (and the callbacks) by the actor: here, CEM answers
        with self.policy.inferring_by("cem", self._select_actions if self._is_captured else None):
            return super()._sample_action(learning_starts, action_noise, n_envs)

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        # Clipping by VecNormalize would hide an infinite value
        normalizer = self._vec_normalize_env
        original_reward = reward if normalizer is None else normalizer.get_original_reward()
        original_obs = new_obs if normalizer is None else normalizer.get_original_obs()
        check_reward(original_reward, self.n_envs, self.num_timesteps)
        check_shape("observation", original_obs, self.observation_space, self.n_envs, self.num_timesteps)
        check_finite("reward", original_reward, self.num_timesteps)
        check_finite("observation", original_obs, self.num_timesteps)
        self._bounds_watch.check(original_obs, self.num_timesteps)
        for info, done in zip(infos, dones, strict=True):
            if done and info.get("terminal_observation") is not None:
                check_shape(
                    "terminal observation", info["terminal_observation"], self.observation_space, None, self.num_timesteps
                )
                check_finite("terminal observation", info["terminal_observation"], self.num_timesteps)
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)

    def train(self, gradient_steps: int, batch_size: int = 128) -> None:
        """
        Do gradient steps on the replay buffer (the inner loop of Algorithm 2).

        :param gradient_steps: number of gradient steps
        :param batch_size: transitions per gradient step
        :raises ValueError: if a loss is NaN or infinite
        """
        assert self.replay_buffer is not None
        # Switch to train mode (this affects batch norm / dropout)
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.critic.optimizer)
        self._update_actor_learning_rate(self._current_progress_remaining)

        losses = []
        for _ in range(gradient_steps):
            self._n_updates += 1
            # Sample a minibatch
            batch = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
            trains_actor = self._trains_policy_online and self._n_updates % self.policy_delay == 0
            updates_averages = self._n_updates % self.target_update_interval == 0
            losses.append(self._step_on(batch, trains_actor, updates_averages))
            if self._n_updates % DIAGNOSTICS_INTERVAL == 0:
                self._log_diagnostics(batch.observations, has_actor=self._trains_policy_online)

        self._policy_is_due = self.policy_training == "offline"
        self._log_training(gradient_steps)
        self._record_losses(losses)

    def _gradient_step(self, batch: ReplayBufferSamples, *turns: bool) -> StepLosses:
        """
        Do one gradient step (Algorithm 2).

        :param batch: a minibatch
        :param turns: whether the actor is trained, and whether the averages move
        :return: the losses
        :raises ValueError: if a loss is NaN or infinite, unless the step is captured
        """
        trains_actor, updates_averages = turns
        # For n-step replay, discount factor is gamma**n_steps (when no early termination)
        discounts = batch.discounts if batch.discounts is not None else self.gamma

        with th.no_grad():
            # Sample next actions by CEM on the first target critic, and smooth them as TD3 does
            next_actions = self.policy.select_actions(batch.next_observations, self.critic_target).actions
            next_actions = smooth_target_actions(next_actions, self.target_policy_noise, self.target_noise_clip)
            # Compute q*, with the min over all target critics
            next_q_values = self.critic_target(batch.next_observations, next_actions)
            target_q_values = bootstrap_target(batch.rewards, batch.dones, discounts, next_q_values)

        # Update the critics
        current_q_values = self.critic(batch.observations, batch.actions)
        loss = self._descend(self.critic.optimizer, critic_loss(current_q_values, target_q_values), "critic")

        # Update the policy: as in TD3, its loss sees the critic just updated
        actor_loss = self._train_actor(batch.observations) if trains_actor else None

        # Update the target critics and the averaged actor
        if updates_averages:
            self._update_average(self.critic, self.critic_target)
            self._update_average(self.actor, self.actor_target)

        return StepLosses(loss, current_q_values[0].detach().mean(), actor_loss)

    def _fixed_in_graphs(self) -> tuple[Any, ...]:
        noise = (self.target_policy_noise, self.target_noise_clip)
        selector = self.policy.selector
        return (self.gamma, self.tau, *noise, self.policy_loss, self.policy.cem_dtype, selector, repr(selector))

    @property
    def _trains_policy_online(self) -> bool:
        return self.policy_loss is not None and self.policy_training == "online"

    def _train_actor(self, observations: th.Tensor) -> th.Tensor:
        """
        Do one gradient step of the actor on the CGP loss or the QGP loss (Algorithm 2).

        :param observations: a batch of observations (tensors by key for ``Dict`` spaces)
        :return: the loss
        """
        actions = self.actor(observations)
        if self.policy_loss == "cgp":
            loss = cgp_loss(actions, self.policy.select_actions(observations, self.critic).actions)
        else:
            loss = qgp_loss(self.critic.q1_forward(observations, actions))
        return self._descend(self.actor.optimizer, loss, "actor")

    def _update_average(self, network: th.nn.Module, average: th.nn.Module) -> None:
        """Move a Polyak average towards its network; batch norm's running statistics are copied (SB3 issue #996)."""
        polyak_update(network.parameters(), average.parameters(), self.tau)
        polyak_update(_running_statistics(network), _running_statistics(average), 1.0)

    def _update_actor_learning_rate(self, progress_remaining: float) -> None:
        rate = self.actor_lr_schedule(progress_remaining)
        self.logger.record("train/actor_learning_rate", rate)
        set_learning_rate(self.actor.optimizer, rate, self._captured_rates.get(self.actor.optimizer))

    def _log_training(self, gradient_steps: int) -> None:
        steps = self.num_timesteps - self._timesteps_trained_at
        self._timesteps_trained_at = self.num_timesteps
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/updates_per_step", gradient_steps / max(steps, 1))

    def _log_diagnostics(self, observations: th.Tensor, has_actor: bool) -> None:
        self._loss_watch.check()
        self.policy.set_training_mode(False)
        for key, value in policy_diagnostics(self.policy, observations, has_actor).items():
            self.logger.record_mean(key, value)
        self.policy.set_training_mode(True)

    @guarded
    def learn(
        self: SelfCGP,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "CGP",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfCGP:
        """
        Learn the Q-functions, and the policy: along with them or, offline, when they are learnt.

        :param total_timesteps: The total number of samples (env steps) to train on
        :param callback: callback(s) called at every step with state of the algorithm, also in the policy's offline
            training, which is a training of its own to them (see :meth:`train_policy`)
        :param log_interval: number of episodes before logging
        :param tb_log_name: the name of the run for TensorBoard logging
        :param reset_num_timesteps: whether or not to reset the current timestep number (used in logging)
        :param progress_bar: Display a progress bar using tqdm and rich.
        :return: the trained model
        :raises ValueError: if a reward, an observation or a loss is NaN or infinite, or of a wrong shape
        :raises RuntimeError: if a worker of a ``SubprocVecEnv`` has died
        """
        super().learn(
            total_timesteps=total_timesteps,
            callback=callback,
            log_interval=log_interval,
            tb_log_name=tb_log_name,
            reset_num_timesteps=reset_num_timesteps,
            progress_bar=progress_bar,
        )
        self._loss_watch.check()
        # Without a gradient step of the critics, there is nothing new for the policy to learn
        if self._policy_is_due:
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

        It has converged when the loss, averaged over rounds of 1,000 gradient steps, has not fallen below its lowest
        value by more than 5 % for 5 rounds in a row. ``learn`` calls it in offline training; call it yourself on a
        loaded model with a loaded replay buffer (and, if it was trained with ``VecNormalize``, its environment set).

        A callback that stops it within its first round leaves CEM to act: so does one that has stopped ``learn`` before.
        Callbacks see each gradient step as a step in which no environment moved: ``num_timesteps`` stands still, no
        episode ends, rewards are 0. Logged values lie at ``num_timesteps`` plus the gradient steps.

        :param max_steps: largest number of gradient steps
        :param batch_size: observations per gradient step, by default the model's
        :param callback: callback(s) called at every gradient step; it stops when one returns False
        :param progress_bar: Display a progress bar using tqdm and rich.
        :return: the model, whose ``predict`` asks from now on what ``inference`` says
        :raises ValueError: if there is no policy loss or no data, or if a loss is NaN or infinite
        """
        require_count("max_steps", max_steps)
        require(self.policy_loss is not None, "policy_loss", self.policy_loss, "'cgp' or 'qgp' to train a policy")
        replay_buffer = self._ensure_replay_buffer()
        require(replay_buffer.size() > 0, "replay_buffer", replay_buffer, "filled, by `learn` or `load_replay_buffer`")
        batch_size = self.batch_size if batch_size is None else batch_size
        require_count("batch_size", batch_size)
        sample = partial(replay_buffer.sample, batch_size, env=self._vec_normalize_env)
        if not hasattr(self, "_logger"):
            # A loaded model that has not learnt yet
            self._logger = configure_logger(self.verbose, self.tensorboard_log, "CGP", reset_num_timesteps=False)

        def step(n_steps: int) -> float:
            # Callbacks may have evaluated the policy
            self.policy.set_training_mode(True)
            self._update_actor_learning_rate(1.0 - (n_steps - 1) / max_steps)
            loss = self._train_actor(sample().observations).item()
            if not np.isfinite(loss):
                self._loss_watch.check()
            if n_steps % self.target_update_interval == 0:
                self._update_average(self.actor, self.actor_target)
            return loss

        def after_round(n_steps: int, loss: float) -> None:
            self.logger.record("train/actor_loss", loss)
            self._log_diagnostics(sample().observations, has_actor=True)
            self.logger.dump(self.num_timesteps + n_steps)

        # Callbacks score and save the actor that is being trained
        is_trained, self._policy_is_trained = self._policy_is_trained, True
        self._choose_inference()
        self.is_training_policy = True
        try:
            callback = self._init_callback(callback)
            n_steps, is_enough = descend_to_plateau(step, after_round, callback, max_steps, self.n_envs, progress_bar)
            is_trained = is_trained or is_enough
            self._policy_is_due = False
        finally:
            self._policy_is_trained = is_trained
            self._choose_inference()
            self.is_training_policy = False
            self._release_signals()
        if self.verbose >= 1:
            print(f"The policy was trained for {n_steps} gradient steps")
        return self

    def export(self, folder: str | Path) -> None:
        """
        Write the policy that ``predict`` asks, to be used elsewhere and loaded without pickle.

        ``policy.onnx`` takes a batch of observations as the environment gives them (images channels first) and returns
        actions as the environment takes them; VecNormalize's statistics, as they are now, are part of it.
        ``policy.safetensors`` and ``policy.json`` are what :meth:`load_weights` reads. Both are asked for a few random
        observations, and compared with ``predict``, before anything is written.

        :param folder: where to write; it is made if it is missing. An export that is there is replaced when all of the
            new one is on the disk.
        :raises ValueError: if the policy cannot be exported, naming what is in the way and what is allowed: an actor must
            act, on a ``Box``, by SB3's own features extractors and one of PyTorch's usual activation functions
        :raises ImportError: if a package of the ``export`` extra is not installed
        """
        export_policy(self, folder)

    @classmethod
    def load_weights(cls, folder: str | Path) -> ExportedPolicy:
        """
        Load a policy that :meth:`export` wrote, from safetensors and JSON alone. Unlike :meth:`load`, it cannot run code
        that someone put into the files.

        :param folder: where the policy was exported to
        :return: a policy that predicts, and cannot be trained; it takes observations that are not normalised
        :raises ValueError: if a file is damaged, of another export, or says what is not allowed; it names the file and why
        :raises FileNotFoundError: if ``policy.json`` or ``policy.safetensors`` is missing
        :raises ImportError: if safetensors is not installed
        """
        return load_weights(folder)

    def _excluded_save_params(self) -> list[str]:
        aliases = ["actor", "actor_target", "critic", "critic_target"]
        return [*super()._excluded_save_params(), *aliases, "_actor_lr_schedule", "_bounds_watch"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts = ["policy", "actor.optimizer", "critic.optimizer"]
        return state_dicts, []
