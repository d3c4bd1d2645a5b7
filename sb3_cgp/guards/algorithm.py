"""
What is checked when: all guards in one class, to be mixed into an off-policy algorithm of SB3's.

To add a check, write a function in the file of its subject, or a context manager that explains an error, and call it here.
"""

import io
import pathlib
from collections.abc import Mapping
from typing import Any, TypeVar

import torch as th
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, RolloutReturn, TrainFreq
from stable_baselines3.common.vec_env import VecEnv

from sb3_cgp.common.load_arguments import saved_attributes
from sb3_cgp.common.rules import require
from sb3_cgp.common.sb3_arguments import replay_buffer_class_of
from sb3_cgp.common.spaces import check_action_space
from sb3_cgp.guards.action_noise import check_action_noise, fit_action_noise
from sb3_cgp.guards.arguments import check_learn_arguments, effective_load_arguments, explaining_policy_kwargs
from sb3_cgp.guards.construction import check_env, check_policy_and_env, check_policy_name, explaining_policy
from sb3_cgp.guards.dummy_vec_env import observing_environments
from sb3_cgp.guards.episodes import EpisodeGuard
from sb3_cgp.guards.explanations import explaining_errors
from sb3_cgp.guards.file_names import find_file
from sb3_cgp.guards.gradients import check_gradients
from sb3_cgp.guards.learning_starts import LearningStartsGuard
from sb3_cgp.guards.networks import check_goals, check_observation_space, try_networks
from sb3_cgp.guards.normalisation import NormalisationGuard, check_wrappers
from sb3_cgp.guards.replay_buffer_fit import (
    check_loaded_replay_buffer,
    check_replay_buffer,
    check_replay_buffer_kwargs,
    fit_replay_buffer,
)
from sb3_cgp.guards.replay_buffer_values import check_contents
from sb3_cgp.guards.seeds import warning_of_missing_seed
from sb3_cgp.guards.transitions import TransitionGuard
from sb3_cgp.guards.workers import discard_replies, watching_workers

SelfGuarded = TypeVar("SelfGuarded", bound="GuardedAlgorithm")


class GuardedAlgorithm(TransitionGuard, EpisodeGuard, LearningStartsGuard, NormalisationGuard):
    """
    An algorithm that notices faults of environments and wrong use, and names them or does the right thing.

    It comes before an algorithm among a class's bases: ``class GuardedTD3(GuardedAlgorithm, TD3)``. Guards that hold a state
    during a training are its own bases, which also override what SB3 does at each step.
    """

    # SB3 has no public method that `load`, `set_env` and the constructor share. Its method is a static one, which could not
    # call that of its base class.
    @classmethod
    def _wrap_env(cls, env: GymEnv | str, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        check_env(env)
        wrapped = super()._wrap_env(maybe_make_env(env, verbose), verbose, monitor_wrapper)
        # Before SB3's assertions on the space
        check_action_space(wrapped.action_space)
        check_wrappers(wrapped)
        return wrapped

    def _get_policy_from_name(self, policy_name: str) -> type[BasePolicy]:
        check_policy_name(policy_name, self.policy_aliases)
        return super()._get_policy_from_name(policy_name)

    def _setup_model(self) -> None:
        check_policy_and_env(self)
        with explaining_policy(self):
            check_action_noise(self.action_noise, self.action_space)
            check_replay_buffer_kwargs(replay_buffer_class_of(self), self.replay_buffer_kwargs)
            check_observation_space(self.observation_space)
            check_goals(self)
            super()._setup_model()
            self._try_networks()
        if self.replay_buffer is not None:
            # One that was saved within the model
            check_loaded_replay_buffer(self.replay_buffer, self)

    def _try_networks(self) -> None:
        """Try the networks that have just been made."""
        try_networks(self)

    def set_random_seed(self, seed: int | None = None) -> None:
        """
        Set the seed of all random generators, as SB3 does, and warn if that of the environments cannot be set.

        :param seed: the seed
        """
        # Python's random generator takes no integer of NumPy's
        seed = None if seed is None else int(seed)
        with warning_of_missing_seed(self.env, seed):
            super().set_random_seed(seed)

    @classmethod
    def load(
        cls: type[SelfGuarded],
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> SelfGuarded:
        """
        Load a model from a zip-file.

        :param path: path to the file, with or without its suffix, or an open file
        :param env: see SB3's method
        :param device: see SB3's method
        :param custom_objects: see SB3's method
        :param print_system_info: see SB3's method
        :param force_reset: see SB3's method
        :param kwargs: arguments to change in the model
        :return: the model
        :raises IsADirectoryError: if the path is a folder without a zip-file of the same name beside it
        :raises TypeError: if a model has no such argument or attribute, naming it and the nearest one that is allowed
        :raises ValueError: if the value of an argument of SB3's is wrong, naming it
        """
        path = find_file(cls, path, "zip")
        cls._check_saved(saved_attributes(path))
        kwargs = effective_load_arguments(cls, path, device, custom_objects, kwargs)
        with explaining_policy_kwargs():
            return super().load(path, env, device, custom_objects, print_system_info, force_reset, **kwargs)

    @classmethod
    def _check_saved(cls, saved: Mapping[str, Any]) -> None:
        """Check the attributes of a saved model before it is loaded; none of a file that ``load`` refuses."""

    def set_parameters(self, load_path_or_dict: Any, *args: Any, **kwargs: Any) -> None:
        """
        Load parameters from a zip-file or a nested dictionary.

        :param load_path_or_dict: path to the file, an open file, or the parameters by module
        :param args: the algorithm's own arguments
        :param kwargs: the algorithm's own arguments
        :raises IsADirectoryError: if the path is a folder without a zip-file of the same name beside it
        """
        super().set_parameters(find_file(type(self), load_path_or_dict, "zip"), *args, **kwargs)

    def load_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool = True) -> None:
        """
        Load a replay buffer from a pickle file. If it does not fit the model, the model keeps the buffer that it has.

        :param path: path to the file, with or without its suffix, or an open file
        :param truncate_last_traj: When using ``HerReplayBuffer`` with online sampling: whether the last trajectory in the
            replay buffer was finished. With False, it is continued where the environment is still at its end.
        :raises IsADirectoryError: if the path is a folder without a pickle file of the same name beside it
        :raises ValueError: if the buffer contradicts an argument of the model, or is of other spaces or of another number of
            environments
        """
        previous = self.replay_buffer
        super().load_replay_buffer(find_file(type(self), path, "pkl"), truncate_last_traj)
        assert self.replay_buffer is not None
        try:
            check_loaded_replay_buffer(self.replay_buffer, self)
        except ValueError:
            self.replay_buffer = previous
            raise

    def learn(
        self: SelfGuarded, total_timesteps: int, callback: Any = None, log_interval: Any = 4, *args: Any, **kwargs: Any
    ) -> SelfGuarded:
        """
        Learn, if the arguments are right, and explain what fails.

        :param total_timesteps: number of environment steps, an integer >= 0, or an equal float such as 1e5
        :param callback: callback(s) called at every step with state of the algorithm.
        :param log_interval: number of episodes between two writings of the log; None for no writing
        :param args: the algorithm's own arguments
        :param kwargs: the algorithm's own arguments
        :return: the trained model
        :raises ValueError: naming the first argument that is wrong, its value and what is allowed, or the fault of an
            environment, or if gradients are off
        :raises RuntimeError: if a worker of a ``SubprocVecEnv`` has died; its environment is closed
        """
        check_gradients(self)
        total_timesteps = check_learn_arguments(self, total_timesteps, callback, log_interval)
        with (
            watching_workers(self),
            explaining_errors(self),
            observing_environments(self),
            self._expecting_gradient_steps(),
        ):
            return super().learn(total_timesteps, callback, log_interval, *args, **kwargs)

    def _setup_learn(
        self, total_timesteps: int, callback: Any = None, reset_num_timesteps: bool = True, *args: Any, **kwargs: Any
    ) -> tuple[int, Any]:
        discard_replies(self.env)
        allowed = f"an environment: `{type(self).__name__}.load(path, env)`, or `set_env` before `learn`"
        require(self.env is not None, "env", self.env, allowed)
        self._fit_action_noise()
        if self.replay_buffer is not None:
            check_replay_buffer(self.replay_buffer, self)
            check_contents(self.replay_buffer)
        with self._beginning_episodes(reset_num_timesteps):
            result = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, *args, **kwargs)
            self._announce_warm_up(result[0], continues=not reset_num_timesteps)
        # The environment has been reset, if it has to be
        self._begin_checks()
        fit_replay_buffer(self)
        return result

    def _fit_action_noise(self) -> None:
        check_action_noise(self.action_noise, self.action_space)
        fit_action_noise(self)

    def collect_rollouts(
        self,
        env: VecEnv,
        callback: BaseCallback,
        train_freq: TrainFreq,
        replay_buffer: ReplayBuffer,
        action_noise: ActionNoise | None = None,
        *args: Any,
        **kwargs: Any,
    ) -> RolloutReturn:
        """
        Collect experiences and store them into the replay buffer, see SB3's method.

        :param env: The training environment
        :param callback: Callback that will be called at each step (and at the beginning and end of the rollout)
        :param train_freq: How much experience to collect
        :param replay_buffer: the replay buffer
        :param action_noise: the model's action noise, which a callback may have set
        :param args: the further arguments of SB3's method
        :param kwargs: the further arguments of SB3's method
        :return: the numbers of steps and episodes, and whether to go on
        :raises ValueError: if the noise cannot be added to an action
        """
        if action_noise is not None:
            self._fit_action_noise()
            action_noise = self.action_noise
        return super().collect_rollouts(env, callback, train_freq, replay_buffer, action_noise, *args, **kwargs)

    def _update_current_progress_remaining(self, num_timesteps: int, total_timesteps: int) -> None:
        super()._update_current_progress_remaining(num_timesteps, total_timesteps)
        # The last rollout may end beyond the planned steps, where a schedule such as `2e-3 * remaining` is negative
        self._current_progress_remaining = max(self._current_progress_remaining, 0.0)
