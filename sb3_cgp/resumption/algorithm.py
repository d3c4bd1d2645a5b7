"""Off-policy algorithms whose training can be interrupted at any time and resumed."""

import copy
import io
import os
import signal
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import torch as th
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, ProgressBarCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.noise import ActionNoise, VectorizedActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, RolloutReturn
from stable_baselines3.common.utils import configure_logger

from sb3_cgp.common.files import whole_file
from sb3_cgp.common.load_arguments import check_load_arguments
from sb3_cgp.common.rules import require
from sb3_cgp.resumption.callback_states import iter_callbacks
from sb3_cgp.resumption.callbacks import TrainingCheckpointCallback, checkpoints_among
from sb3_cgp.resumption.locks import FolderLock
from sb3_cgp.resumption.logs import continued_logger
from sb3_cgp.resumption.model import ResumableModel
from sb3_cgp.resumption.parameters import freeze_parameters, warn_of_lost_schedules
from sb3_cgp.resumption.progress_bars import show_whole_training
from sb3_cgp.resumption.replay_buffers import fill_replay_buffer
from sb3_cgp.resumption.state import begin_new_episode, check_fits
from sb3_cgp.resumption.store import StateStore

# The errors of an environment whose process has ended
LOST_PROCESS = (EOFError, ConnectionError)

SelfResumableAlgorithm = TypeVar("SelfResumableAlgorithm", bound="ResumableAlgorithm")


@contextmanager
def _whole(path: str | Path | io.BufferedIOBase, suffix: str) -> Iterator[Any]:
    """
    Open a file that appears under its name when it is complete. Yield anything but a path as it is, such as an open file.

    Add the suffix as SB3 does, and to the name of a folder, for which SB3 would choose a name that ``load`` does not find.
    """
    if not isinstance(path, str | os.PathLike):
        # SB3 names the files that it takes
        yield path
        return
    path = Path(path)
    with whole_file(path if path.suffix and not path.is_dir() else path.with_name(path.name + suffix)) as file:
        yield file


def _number_of_noises(noise: ActionNoise | None) -> int | None:
    """Return for how many environments action noise is vectorised; None if it is not."""
    return len(noise.noises) if isinstance(noise, VectorizedActionNoise) else None


class ResumableAlgorithm(ResumableModel):
    """
    An algorithm that resumes from the states of a :class:`~sb3_cgp.resumption.callbacks.TrainingCheckpointCallback`.

    It must be the first base class of an algorithm. :func:`resumable` derives such a class from an off-policy algorithm.
    """

    @classmethod
    def resume(
        cls: type[SelfResumableAlgorithm],
        path: str | Path,
        env: GymEnv | str,
        device: th.device | str = "auto",
        **kwargs: Any,
    ) -> SelfResumableAlgorithm:
        """
        Load the newest undamaged state of an interrupted training.

        The model's next ``learn`` continues that training: give it the arguments of the first call. Its ``total_timesteps``
        counts from the training's start, so that the training ends where it would have ended. Without a
        ``TrainingCheckpointCallback`` among its callbacks, states are saved as before. A progress bar shows the whole
        training. With ``verbose=1``, the step is printed. Until ``learn`` ends or the model is deleted, no other training can
        use the folder.

        The state holds SB3's zip, which is unpickled and can run code, as with :meth:`load`: resume your own trainings only.

        :param path: the folder of the states
        :param env: the environment, made as for the first call (if registered in Gym, can be str); its state is restored when
            ``learn`` starts
        :param device: Device on which the code should run.
        :param kwargs: arguments to change in the model, and those of :meth:`load` but for ``force_reset``, as the state of the
            environment is restored
        :return: the model
        :raises FileNotFoundError: if the folder holds no state
        :raises ValueError: if all states are damaged, naming the files, or if the environment or an argument does not fit
        :raises TypeError: if a model has no such argument or attribute, naming it and the nearest one that is allowed
        :raises FolderInUseError: if another training uses the folder, naming its host and process
        """
        store = StateStore(Path(path).resolve())
        lock = FolderLock(store.folder)
        if store.steps():
            lock.acquire()
        elif store.folder.is_file() or Path(f"{store.folder}.zip").is_file():
            raise FileNotFoundError(f"There is no training state in {store.folder}: `load` reads a model that `save` wrote")
        try:
            model = cls._load_state(store, env, device, **kwargs)
        except BaseException:
            lock.release()
            raise
        model._note_training(folder_locks={store.folder: lock})
        if model.verbose >= 1:
            print(f"Resuming the training in {path} at step {model.num_timesteps}")
        return model

    @classmethod
    def _load_state(
        cls: type[SelfResumableAlgorithm], store: StateStore, env: GymEnv | str, device: th.device | str, **kwargs: Any
    ) -> SelfResumableAlgorithm:
        """Load the newest undamaged state of a locked folder."""
        digests = store.digests()
        _, state = store.load()
        require(state["algorithm"] == cls.__name__, "path", str(store.folder), f"of {cls.__name__}, not {state['algorithm']}")
        saved = io.BytesIO(state.pop("model"))
        if "force_reset" in kwargs:
            raise TypeError(
                f"The value of `force_reset` is {kwargs['force_reset']!r}, but `{cls.__name__}.resume` takes no such argument."
                " Leave it out: a resumed training restores the environment's state. `load` takes it, for a new episode."
            )
        check_load_arguments(cls, saved, kwargs, "resume")
        model = cls.load(saved, cls._make_env(env, saved), device, force_reset=False, **kwargs)
        assert model.env is not None
        check_fits(model, state)
        freeze_parameters(model.policy, state["frozen"])
        # Model and environment must share the space, as wrappers may draw random actions from it, too
        model.action_space = model.env.action_space
        changed = kwargs.get("replay_buffer_kwargs") or ()
        fill_replay_buffer(model._ensure_replay_buffer(), state.pop("replay_buffer"), changed)
        model.resumption = state | {
            "checkpoint": state["checkpoint"] | {"path": store.folder},
            # `set_env` would reset these attributes
            "last": {name: getattr(model, name) for name in ("_last_obs", "_last_episode_starts", "_last_original_obs")},
        }
        model.saved_to = {store.folder: digests}
        return model

    @classmethod
    def _make_env(cls, env: GymEnv | str, saved: Any) -> GymEnv:
        """Make the environment of a saved model if its name is given. Subclasses that need several of them override this."""
        return maybe_make_env(env, 0)

    def save(
        self,
        path: str | Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """
        Save all the attributes of the object and the model parameters in a zip-file.

        The file is written completely or not at all. A warning names a schedule that was set on the model and will be lost.

        :param path: path to the file where the rl agent should be saved
        :param exclude: name of parameters that should be excluded in addition to the default ones
        :param include: name of parameters that might be excluded but should be included anyway
        :raises OSError: if it cannot be written; an existing file is then not changed
        """
        warn_of_lost_schedules(self)
        with _whole(path, ".zip") as file:
            super().save(file, exclude, include)

    def save_replay_buffer(self, path: str | Path | io.BufferedIOBase) -> None:
        """
        Save the replay buffer as a pickle file, which is written completely or not at all.

        :param path: Path to the file where the replay buffer should be saved.
            if path is a str or pathlib.Path, the path is automatically created if necessary.
        :raises OSError: if it cannot be written; an existing file is then not changed
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
        # SB3 resets the noise
        action_noise = copy.deepcopy(self.action_noise)
        has_logger = self._custom_logger
        if not has_logger and self.tensorboard_log is not None:
            # SB3 would continue in the folder of the newest run
            self.set_logger(self._continued_logger(kwargs.get("tb_log_name", args[0] if args else "run")))
        steps_left = self._training_started_at + total_timesteps - self.num_timesteps
        result = super()._setup_learn(steps_left, callback, False, *args, **kwargs)
        self._custom_logger = has_logger
        # Unless it was given to `resume`, and has just been adapted to the number of environments
        if _number_of_noises(action_noise) == _number_of_noises(self.action_noise):
            # Not by `setattr`: a population refuses other noise
            vars(self)["action_noise"] = action_noise
        return result

    def _continued_logger(self, name: str) -> Logger:
        """Return a logger for TensorBoard in the training's folder; in a new one if that is gone, or another was given."""
        assert self.resumption is not None
        folder, is_same = self.resumption["log_folder"], self.resumption.get("tensorboard_log") == str(self.tensorboard_log)
        if is_same and folder is not None and os.path.isdir(folder):
            return continued_logger(folder, self.num_timesteps + 1, self.verbose)
        return configure_logger(self.verbose, self.tensorboard_log, name, reset_num_timesteps=True)

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        callback = super()._init_callback(callback, progress_bar)
        checkpoints = checkpoints_among(callback)
        for each in checkpoints:
            allowed = "None: give a TrainingCheckpointCallback to `learn` itself. Other callbacks do not report rollouts to it"
            require(each.parent is None, "parent", each.parent, allowed)
        bars = [each for each in iter_callbacks(callback) if isinstance(each, ProgressBarCallback)]
        for bar in bars if self.resumption is not None else ():
            show_whole_training(bar, self)
        if self.resumption is not None and not checkpoints:
            self._note_training(added_checkpoint=TrainingCheckpointCallback(**self.resumption["checkpoint"]))
        added = self._training.added_checkpoint
        if added is not None and not checkpoints:
            # Also in the offline training of a policy that follows, which saves a state at its end
            added.init_callback(self)
            callback = CallbackList([callback, added])
            # Not initialised, as SB3 has initialised the first of them
            callback.model = self
        self._note_training(callback=callback)
        return callback

    def collect_rollouts(self, *args: Any, **kwargs: Any) -> RolloutReturn:
        """
        Collect experiences, see SB3's method, after states have been restored and saved.

        :param args: the arguments of SB3's method
        :param kwargs: the same arguments by keyword
        :return: the numbers of steps and episodes, and whether to go on
        """
        # Not by the callback's `on_rollout_start`, before which SB3 draws the noise of gSDE
        for each in self._checkpoints():
            each.begin_rollout()
        return super().collect_rollouts(*args, **kwargs)

    def learn(self: SelfResumableAlgorithm, *args: Any, **kwargs: Any) -> SelfResumableAlgorithm:
        """
        Train the model, or resume its interrupted training.

        :param args: the algorithm's own arguments
        :param kwargs: the algorithm's own arguments
        :return: the trained model
        :raises FolderInUseError: if a folder for training states is used by another training
        """
        with self.as_training():
            return super().learn(*args, **kwargs)

    @contextmanager
    def as_training(self) -> Iterator[None]:
        """
        Return a context for a training. At its end, also by an error, signals are handled as before the training.

        ``learn`` runs within it, and so must any other method that calls callbacks. Contexts may be nested. The outermost one
        also releases the folders of states, and removes the callbacks from the model.
        """
        outer = self._training
        self._note_training(n_nested=outer.n_nested + 1)
        self._training_has_ended = False
        try:
            yield
        except (Exception, SystemExit) as error:
            # A terminal sends Ctrl-C to the environments' processes, too, which end by it
            if self._is_interrupted and any(isinstance(each, LOST_PROCESS) for each in (error, error.__cause__)):
                self._stop_if_asked()
            for each in self._checkpoints():
                each.signals.pass_on()
            raise
        else:
            self._training_has_ended = outer.n_nested == 0
            # The signal came during the last step or the saving of its state. The code after `learn` could take too long.
            self._stop_if_asked()
        finally:
            for each in self._checkpoints():
                each.release()
            self._note_training(n_nested=outer.n_nested, callback=outer.callback)
            if outer.n_nested == 0:
                # Callbacks, too, as they hold environments and files
                self._forget_training()

    def _checkpoints(self) -> list[TrainingCheckpointCallback]:
        """Return the callbacks of the training in progress that save states."""
        callback = self._training.callback
        return [] if callback is None else checkpoints_among(callback)

    @property
    def _is_interrupted(self) -> bool:
        """Whether Ctrl-C has been pressed."""
        return any(each.signals.noted == signal.SIGINT for each in self._checkpoints())

    def _stop_if_asked(self) -> None:
        for each in self._checkpoints():
            each.stop_if_asked()


def resumable(algorithm: type[OffPolicyAlgorithm]) -> type[ResumableAlgorithm]:
    """
    Return a subclass of an off-policy algorithm that adds saving and resuming its training.

    :param algorithm: the algorithm, such as SB3's TD3
    :return: a subclass of the same name
    """
    if issubclass(algorithm, ResumableAlgorithm):
        return algorithm
    return type(algorithm.__name__, (ResumableAlgorithm, algorithm), {"__doc__": algorithm.__doc__})
