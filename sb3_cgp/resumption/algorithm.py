"""Algorithms whose training can be stopped anywhere, by whatever, and go on as if it had not been."""

import copy
import io
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import torch as th
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback

from sb3_cgp.common.files import whole_file
from sb3_cgp.common.rules import require
from sb3_cgp.resumption.callbacks import TrainingCheckpointCallback
from sb3_cgp.resumption.logs import continued_logger
from sb3_cgp.resumption.state import State, begin_new_episode, fill_replay_buffer, walk
from sb3_cgp.resumption.store import StateStore

SelfResumableAlgorithm = TypeVar("SelfResumableAlgorithm", bound="ResumableAlgorithm")


@contextmanager
def _whole(path: str | Path | io.BufferedIOBase, suffix: str) -> Iterator[Any]:
    """Open a file to be written as a whole, named as SB3 names it; what is open already is left to whoever opened it."""
    if isinstance(path, io.BufferedIOBase):
        yield path
        return
    path = Path(path)
    with whole_file(path if path.suffix else path.with_name(path.name + suffix)) as file:
        yield file


class ResumableAlgorithm(OffPolicyAlgorithm):
    """
    An algorithm that goes on from the states that a :class:`~sb3_cgp.resumption.callbacks.TrainingCheckpointCallback` saves.

    It comes first among an algorithm's bases: :func:`resumable` makes one of any of SB3's off-policy algorithms.
    """

    # The training's callbacks
    callback: BaseCallback
    # What is to be restored when the training goes on
    resumption: State | None = None
    # The folders that this training's states are in
    saved_to: frozenset[Path] = frozenset()
    # Environment steps when the training started that is going on, or was interrupted
    _training_started_at: int = 0
    # Whether the critics have learnt since the policy was last trained offline
    _policy_is_due: bool = False
    # Whether this is the policy's offline training
    is_training_policy: bool = False

    @classmethod
    def resume(
        cls: type[SelfResumableAlgorithm],
        path: str | Path,
        env: GymEnv | str,
        device: th.device | str = "auto",
        **kwargs: Any,
    ) -> SelfResumableAlgorithm:
        """
        Load the newest undamaged state of a training that was interrupted.

        The model's next ``learn`` goes on with that training: give it the arguments that it had at first. Its
        ``total_timesteps`` means what it meant, so that the training ends where it would have ended. Without a
        ``TrainingCheckpointCallback`` among its callbacks, states go on being saved as before.

        The state holds SB3's zip, which is unpickled and can run code, as with :meth:`load`: resume your own trainings only.

        :param path: the folder of the states
        :param env: the environment, made as at first (if registered in Gym, can be str); its state is restored when
            ``learn`` starts
        :param device: Device on which the code should run.
        :param kwargs: arguments to change in the model, see :meth:`load`
        :return: the model
        :raises FileNotFoundError: if the folder holds no state
        :raises ValueError: if all states are damaged, naming the files, or if the environment or an argument does not fit
        """
        _, state = StateStore(path).load()
        require(state["algorithm"] == cls.__name__, "path", str(path), f"of {cls.__name__}, not {state['algorithm']}")
        model = cls.load(io.BytesIO(state.pop("model")), maybe_make_env(env, 0), device, force_reset=False, **kwargs)
        assert model.env is not None
        require(model.n_envs == state["n_envs"], "env.num_envs", model.n_envs, f"{state['n_envs']}, as was saved")
        # The same object, as at first: environments may draw from it, too
        model.action_space = model.env.action_space
        fill_replay_buffer(model._ensure_replay_buffer(), state.pop("replay_buffer"))
        model.resumption = state | {
            "checkpoint": state["checkpoint"] | {"path": path},
            # `set_env` would forget them
            "last": {name: getattr(model, name) for name in ("_last_obs", "_last_episode_starts", "_last_original_obs")},
        }
        model.saved_to = frozenset({Path(path).resolve()})
        return model

    def save(
        self,
        path: str | Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """
        Save all the attributes of the object and the model parameters in a zip-file, which appears as a whole or not at all.

        :param path: path to the file where the rl agent should be saved
        :param exclude: name of parameters that should be excluded in addition to the default ones
        :param include: name of parameters that might be excluded but should be included anyway
        :raises OSError: if it cannot be written; a file that was there is as it was
        """
        with _whole(path, ".zip") as file:
            super().save(file, exclude, include)

    def save_replay_buffer(self, path: str | Path | io.BufferedIOBase) -> None:
        """
        Save the replay buffer as a pickle file, which appears as a whole or not at all.

        :param path: Path to the file where the replay buffer should be saved.
            if path is a str or pathlib.Path, the path is automatically created if necessary.
        :raises OSError: if it cannot be written; a file that was there is as it was
        """
        with _whole(path, ".pkl") as file:
            super().save_replay_buffer(file)

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        *args: Any,
        **kwargs: Any,
    ) -> tuple[int, BaseCallback]:
        if self.resumption is None:
            result = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, *args, **kwargs)
            self._training_started_at = self._num_timesteps_at_start
            return result
        if self.resumption["environment"] is None:
            begin_new_episode(self, self.resumption)
        # SB3 resets it
        action_noise = copy.deepcopy(self.action_noise)
        has_logger, folder = self._custom_logger, self.resumption["log_folder"]
        if not has_logger and self.tensorboard_log is not None and folder is not None and os.path.isdir(folder):
            # SB3's would be the newest run's
            self.set_logger(continued_logger(folder, self.num_timesteps + 1, self.verbose))
        steps_left = self._training_started_at + total_timesteps - self.num_timesteps
        result = super()._setup_learn(steps_left, callback, False, *args, **kwargs)
        self.action_noise, self._custom_logger = action_noise, has_logger
        return result

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        callback = super()._init_callback(callback, progress_bar)
        checkpoints = [each for each in walk(callback) if isinstance(each, TrainingCheckpointCallback)]
        for each in checkpoints:
            allowed = "None: give a TrainingCheckpointCallback to `learn` itself, as others do not tell it when a step is over"
            require(each.parent is None, "parent", each.parent, allowed)
        if self.resumption is not None and not checkpoints:
            callback = CallbackList([callback, TrainingCheckpointCallback(**self.resumption["checkpoint"])])
            callback.init_callback(self)
        self.callback = callback
        return callback

    def _ensure_replay_buffer(self) -> ReplayBuffer:
        """Find the replay buffer, which SB3's algorithms allocate when they are made or loaded."""
        ensure = getattr(super(), "_ensure_replay_buffer", None)
        if ensure is not None:
            return ensure()
        assert self.replay_buffer is not None
        return self.replay_buffer

    def learn(self: SelfResumableAlgorithm, *args: Any, **kwargs: Any) -> SelfResumableAlgorithm:
        """
        Learn as the algorithm does, or go on with that.

        :param args: the algorithm's own arguments
        :param kwargs: the algorithm's own arguments
        :return: the trained model
        """
        try:
            return super().learn(*args, **kwargs)
        finally:
            self._release_signals()

    def _release_signals(self) -> None:
        """Let signals act as they did before the training, however it has ended."""
        for each in walk(self.callback) if hasattr(self, "callback") else ():
            if isinstance(each, TrainingCheckpointCallback):
                each.release()

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "callback", "resumption", "saved_to", "is_training_policy"]


def resumable(algorithm: type[OffPolicyAlgorithm]) -> type[ResumableAlgorithm]:
    """
    Make an off-policy algorithm one whose training can be saved and resumed, and which is the same otherwise.

    :param algorithm: the algorithm, such as SB3's TD3
    :return: a subclass of its name
    """
    if issubclass(algorithm, ResumableAlgorithm):
        return algorithm
    return type(algorithm.__name__, (ResumableAlgorithm, algorithm), {"__doc__": algorithm.__doc__})
