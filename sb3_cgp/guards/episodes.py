"""Episodes that end unseen: an environment that was reset or stepped elsewhere, or a step that was not stored."""

import copy
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, ClassVar, NamedTuple

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import GymEnv, RolloutReturn
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_cgp.common.replay_buffers import end_last_episode
from sb3_cgp.common.transient import TransientAttributes
from sb3_cgp.guards.explanations import explaining_early_reset
from sb3_cgp.guards.observations import (
    continues_last_episode,
    count_envs,
    innermost,
    position_of,
    same_observations,
    same_position,
)

MOVED = "it was reset or stepped outside of this training"


class EpisodeGuard(TransientAttributes):
    """
    An algorithm that stores only steps that were made, and lets no episode of its replay buffer run into the next one.

    Before each action it compares where the environment is with where its own last step left it. A new episode starts, and
    the buffer's last one ends, where they differ: after an evaluation or another training on the same environment, and
    where a callback or an exception ended a training before the last step was stored.
    """

    TRANSIENT: ClassVar[tuple[str, ...]] = ("_is_in_rollout",)
    # Where the model's own last step, or its reset, left the environment; None where that is unknown, as after `load`
    _left_env_at: "_EnvMark | None" = None
    # The step of the training's own that is not stored yet
    _own_step: "_OwnStep | None" = None
    _has_warned_of_moves: bool = False
    _is_in_rollout: bool = False

    @contextmanager
    def _beginning_episodes(self, reset_num_timesteps: bool) -> Iterator[None]:
        """Let SB3 reset an environment that has moved, within the context, and end the last episode unless it goes on."""
        reason = "a training that begins, or goes on in another environment, starts with a new episode"
        if self._env_has_moved():
            reason = MOVED if self._own_step is None else "its last step was interrupted before it was stored"
            self._last_obs = None
        elif count_envs(self._original_last_obs) != self.n_envs:
            self._last_obs = None
        # SB3 resets the environment then
        is_reset = reset_num_timesteps or self._last_obs is None
        with explaining_early_reset(reason):
            yield
        self._has_warned_of_moves = False
        if is_reset:
            self._note_reset()
        elif self.replay_buffer is not None and not continues_last_episode(self.replay_buffer, self._original_last_obs):
            end_last_episode(self.replay_buffer)

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """
        Set the environment, see SB3's method.

        :param env: The environment for learning a policy
        :param force_reset: Force call to ``reset()`` before training. With False, the environment must be in the state that
            the model's last observation is of. A ``DummyVecEnv`` that is not is reset when ``learn`` starts.
        :raises RuntimeError: if a callback calls it in the middle of a step
        """
        if self._own_step is not None and self._own_step.position is not None and self._is_in_rollout:
            raise RuntimeError(
                "`set_env` was called by a callback in the middle of a step, whose transition would be lost: call it in "
                "`_on_rollout_end`, when the step is over, or between two calls of `learn`."
            )
        previous = innermost(self.env)
        super().set_env(env, force_reset)
        assert self.env is not None
        if innermost(self.env) is not previous:
            self._left_env_at = None

    def collect_rollouts(self, env: VecEnv, callback: BaseCallback, *args: Any, **kwargs: Any) -> RolloutReturn:
        """
        Collect experiences and store them into the replay buffer, see SB3's method.

        :param env: The training environment
        :param callback: Callback that will be called at each step (and at the beginning and end of the rollout)
        :param args: the further arguments of SB3's method
        :param kwargs: the further arguments of SB3's method
        :return: the numbers of steps and episodes, and whether to go on
        """
        self._is_in_rollout = True
        try:
            return super().collect_rollouts(env, _StepObserver(callback, self), *args, **kwargs)  # type: ignore[arg-type]
        finally:
            self._is_in_rollout = False

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        if self._last_obs is None:
            # A callback has set another environment between two rollouts
            self._begin_episode(action_noise)
        elif self._env_has_moved() or (self._left_env_at is None and self._env_differs()):
            self._warn_of_move()
            self._begin_episode(action_noise)
        actions = super()._sample_action(learning_starts, action_noise, n_envs)
        # From here on the environment may be anywhere if an exception ends the step
        self._own_step = _OwnStep()
        return actions

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)
        # The environment may return an array that its next step overwrites
        self._last_obs = copy.deepcopy(self._last_obs)
        position = None if self._own_step is None else self._own_step.position
        self._left_env_at = None if position is None else _EnvMark(self._last_obs, position)
        self._own_step = None

    @property
    def _original_last_obs(self) -> Any:
        return self._last_obs if self._vec_normalize_env is None else self._last_original_obs

    def _note_step(self) -> None:
        """Remember where the model's own step has left the environment, before callbacks are told of it."""
        assert self.env is not None
        self._own_step = _OwnStep(position_of(self.env))

    def _note_reset(self) -> None:
        """End the replay buffer's last episode after a reset, and remember where the environment is."""
        assert self.env is not None
        self._last_obs = copy.deepcopy(self._last_obs)
        self._left_env_at = _EnvMark(self._last_obs, position_of(self.env))
        self._own_step = None
        if self.replay_buffer is not None:
            end_last_episode(self.replay_buffer)

    def _warn_of_move(self) -> None:
        if not self._has_warned_of_moves:
            self._has_warned_of_moves = True
            warnings.warn(
                f"The training environment was reset or stepped outside of this training, at environment step "
                f"{self.num_timesteps}: it is reset, and the episode that was interrupted ends there. Evaluate on an "
                "environment of its own, to keep episodes whole. This is said once in a training.",
                stacklevel=2,
            )

    def _begin_episode(self, action_noise: ActionNoise | None) -> None:
        """Reset the environment during the training."""
        assert self.env is not None
        with explaining_early_reset(MOVED):
            self._last_obs = self.env.reset()  # type: ignore[assignment]
        self._last_episode_starts = np.ones(self.env.num_envs, dtype=bool)
        if self._vec_normalize_env is not None:
            self._last_original_obs = self._vec_normalize_env.get_original_obs()
        if action_noise is not None:
            action_noise.reset()
        self._note_reset()
        self._check_first_observations()

    def _check_first_observations(self) -> None:
        """Check the observations that an episode starts with, where the algorithm has such checks."""

    def _env_has_moved(self) -> bool:
        """Return whether the environment is known to be elsewhere than where the model's last stored step left it."""
        mark = self._left_env_at
        if self._own_step is not None:
            # A step that was made and not stored
            return True
        if mark is None or self.env is None or self._last_obs is None or self._last_obs is not mark.last_obs:
            # Nothing is known, or the last observation was set on purpose, as in resuming a training
            return False
        position = position_of(self.env)
        return not same_position(position, mark.position)

    def _env_differs(self) -> bool:
        """Return whether the environment shows other observations than the model's last ones, as far as it shows any."""
        assert self.env is not None
        bare = self.env if self._vec_normalize_env is None else self._vec_normalize_env.venv
        # Within wrappers of other kinds, observations may differ rightly
        if not isinstance(bare, DummyVecEnv) or (
            self._vec_normalize_env is not None and self._vec_normalize_env is not self.env
        ):
            return False
        # By the key None where observations have none
        return not same_observations(bare.buf_obs, self._original_last_obs)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_left_env_at", "_own_step", "_has_warned_of_moves"]


class _EnvMark(NamedTuple):
    """
    A moment in an environment's run.

    :param last_obs: the model's last observations at the time
    :param position: the objects that :func:`~sb3_cgp.guards.observations.position_of` returned at the time
    """

    last_obs: Any
    position: tuple[Any, ...]


class _OwnStep(NamedTuple):
    """
    A step of the training's own.

    :param position: the objects that :func:`~sb3_cgp.guards.observations.position_of` returned after it; None until then
    """

    position: tuple[Any, ...] | None = None


class _StepObserver:
    """
    Stand in for a rollout's callback, to note each step before the callback is told of it.

    SB3 has no other method between a step and its callbacks.

    :param callback: the rollout's callback
    :param model: the model that is learning
    """

    def __init__(self, callback: BaseCallback, model: EpisodeGuard):
        self._callback, self._model = callback, model
        self.on_rollout_start, self.on_rollout_end = callback.on_rollout_start, callback.on_rollout_end

    def update_locals(self, locals_: dict[str, Any]) -> None:
        """
        Note the step, and update the callback's view of it.

        :param locals_: the local variables of the rollout
        """
        self._model._note_step()
        locals_["callback"] = self._callback
        self._callback.update_locals(locals_)

    def on_step(self) -> bool:
        """
        Call the callback, which may step or reset the environment, and give ``VecNormalize`` back what the step returned.

        SB3, and the checks of a transition, ask it for the last step's values.

        :return: whether to go on
        """
        normalizer = self._model._vec_normalize_env
        if normalizer is None:
            return self._callback.on_step()
        values = normalizer.old_obs, normalizer.old_reward
        goes_on = self._callback.on_step()
        normalizer.old_obs, normalizer.old_reward = values
        return goes_on
