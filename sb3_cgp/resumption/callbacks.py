"""A callback that saves the complete training state, so that an interrupted training can be resumed."""

import warnings
from contextlib import suppress
from pathlib import Path

from stable_baselines3.common.callbacks import BaseCallback

from sb3_cgp.common.rules import require, require_count
from sb3_cgp.resumption.callback_states import initial_attributes, iter_callbacks
from sb3_cgp.resumption.model import ResumableModel
from sb3_cgp.resumption.parameters import check_optimizers
from sb3_cgp.resumption.replay_buffers import check_savable
from sb3_cgp.resumption.signals import StopSignals, end_training
from sb3_cgp.resumption.state import gather, restore
from sb3_cgp.resumption.store import StateStore


class TrainingCheckpointCallback(BaseCallback):
    """
    Save the complete training state periodically, and when the training ends, for :meth:`ResumableAlgorithm.resume`.

    SB3 calls ``on_step`` before it has stored the transition and taken the gradient steps. A state that is due is therefore
    saved before the next rollout starts. A state is also saved at the end of a training without rollouts, such as CGP's
    offline training of a policy.

    On SIGTERM, which a cluster's scheduler sends, and on Ctrl-C, the state is saved when the next rollout would start. Then
    the process exits with status 143, or ``learn`` raises ``KeyboardInterrupt``. A handler of SIGTERM that was set before is
    called in between. A training without rollouts ends at its next step without saving: ``learn`` has saved the state at its
    start, and a user's call of ``train_policy`` is to be repeated. A second signal has the effect that it has without this
    callback. Of several such callbacks, the first one handles the signals. A training within a callback of a training that
    saves states runs to its end; then the outer one saves its state and ends.

    One training at a time can use the folder. It is locked from ``resume``, or the start of ``learn``, until ``learn`` ends.

    :param save_freq: environment steps between two states, those of all environments together
    :param path: the folder for the states. With None, nothing is saved, except in rl_zoo3, where it stands for the
        folder ``state`` in the run's folder. A relative path is resolved when the callback is constructed.
    :param keep: how many states to keep, the newest ones
    :param verbose: Verbosity level: 0 for no output, 2 for indicating when a state is saved
    :raises ValueError: if an argument is out of its range, or, when the training starts, if the folder holds the states of
        another training, the model has no environment, or the replay buffer cannot be saved; then, or when a state is due,
        if an optimizer was set on the model that a resumed training would not have
    :raises FolderInUseError: when the training starts, if another training uses the folder
    :raises OSError: when the training starts or a state is due, if the folder cannot be written to
    """

    model: ResumableModel

    def __init__(self, save_freq: int, path: str | Path | None = None, keep: int = 2, verbose: int = 0):
        super().__init__(verbose)
        require_count("save_freq", save_freq)
        require_count("keep", keep)
        self.save_freq = save_freq
        self.path = path
        self.keep = keep
        self._saved_at = 0
        self._has_stepped = False
        self._is_in_rollouts = False
        # `learn` may end in the middle of a step, and a training without rollouts may follow
        self._is_within_step = False
        self._has_noted_callbacks = False
        self.signals = StopSignals()
        # This callback and the training's others that save states, in the order in which SB3 calls them
        self._saving: list[TrainingCheckpointCallback] = []

    @property
    def path(self) -> str | Path | None:
        """The folder for the states, as it was given."""
        return self._path

    @path.setter
    def path(self, path: str | Path | None) -> None:
        self._path = path
        # Resolved now, as the process may change its working directory
        self._folder = Path("" if path is None else path).resolve()

    @property
    def has_state(self) -> bool:
        """Whether the folder holds a state."""
        return self.path is not None and len(StateStore(self._folder).steps()) > 0

    def _on_training_start(self) -> None:
        self._is_in_rollouts = self._has_stepped = False
        self._has_noted_callbacks = False
        self._saved_at = self.num_timesteps
        if self.path is None:
            allowed = "TrainingCheckpointCallback(save_freq, path='run/state')"
            warnings.warn(
                f"No state of the training will be saved, as `path` is None; give a folder, as in {allowed}.", stacklevel=2
            )
            return
        allowed = "set, by `set_env` or the argument `env` of `load`, where the training is saved"
        require(self.model.env is not None, "env", None, allowed)
        check_savable(self.model._ensure_replay_buffer())
        check_optimizers(self.model)
        self._store = StateStore(self._folder, self.keep)
        # `prepare` names a folder that cannot be made
        with suppress(OSError):
            self._folder.mkdir(parents=True, exist_ok=True)
        # Before anything is written to it
        self.model.hold_folder(self._folder)
        self._store.prepare()
        known = self.model.saved_to.get(self._folder, frozenset())
        is_another = not self._store.digests() <= known
        allowed = "a folder without the states of another training: continue that one by `resume`, or choose another folder"
        require(not is_another, "path", str(self.path), allowed)
        self._saving = [each for each in checkpoints_among(self._all_callbacks) if each.path is not None]
        self.signals.watch()

    def begin_rollout(self) -> None:
        """Restore the state of a resumed training, or save the state if it is due, before anything of a rollout happens."""
        self._is_in_rollouts = True
        self._is_within_step = False
        self._note_callbacks()
        self._restore_if_resumed()
        if self.path is None:
            return
        asked = next((each for each in self._saving if each.signals.noted is not None), None)
        if asked is not None:
            if self.num_timesteps > self._saved_at or not self.has_state:
                self._save()
            # The others save, too
            if self is self._saving[-1]:
                asked.stop_if_asked()
        elif self.num_timesteps // self.save_freq > self._saved_at // self.save_freq:
            self._save()

    def _on_step(self) -> bool:
        self._has_stepped = True
        self._note_callbacks()
        if self._is_in_rollouts:
            self._is_within_step = True
        else:
            self.stop_if_asked()
        return True

    def _on_rollout_end(self) -> None:
        self._is_within_step = False

    def _on_training_end(self) -> None:
        self._restore_if_resumed()
        # A callback may have ended the training in the middle of a step. rl_zoo3 calls this method twice, and after errors.
        is_whole = self._has_stepped and not self._is_within_step
        self._has_stepped = False
        if self.path is not None and is_whole:
            self._save()
        self.signals.restore()

    def save(self) -> None:
        """Save the state now: after a training within ``learn`` that calls no callbacks, as a population's of its actors."""
        if self.path is not None:
            self._save()

    def get_training_state(self) -> dict[str, int]:
        """
        Return the counters.

        :return: the counters by name
        """
        return {"n_calls": self.n_calls, "num_timesteps": self.num_timesteps}

    def set_training_state(self, state: dict[str, int]) -> None:
        """
        Restore the counters.

        :param state: the counters that :meth:`get_training_state` returned
        """
        self.n_calls, self.num_timesteps = state["n_calls"], state["num_timesteps"]

    @property
    def _all_callbacks(self) -> BaseCallback:
        """The training's callbacks, this one among them."""
        callback = self.model._training.callback
        assert callback is not None
        return callback

    def _note_callbacks(self) -> None:
        """Note the attributes of all callbacks, once they have been told that the training starts."""
        if self.path is not None and not self._has_noted_callbacks:
            self._has_noted_callbacks = True
            # A policy's offline training begins with callbacks that have counted
            noted = initial_attributes(self._all_callbacks) | dict(self.model._training.initial_callbacks)
            self.model._note_training(initial_callbacks=noted)

    def _restore_if_resumed(self) -> None:
        if self.model.resumption is not None:
            restore(self.model, self._all_callbacks, self.model.resumption)
            self.model.resumption = None
            self._saved_at = self.num_timesteps = self.model.num_timesteps

    def _save(self) -> None:
        settings = {"save_freq": self.save_freq, "keep": self.keep, "verbose": self.verbose}
        state = gather(self.model, self._all_callbacks)
        self._store.save(self.num_timesteps, state | {"checkpoint": settings})
        self._saved_at = self.num_timesteps
        self.model.saved_to = {**self.model.saved_to, self._folder: self._store.digests()}
        if self.verbose >= 2:
            print(f"Saving the training state of step {self.num_timesteps} to {self.path}")

    def stop_if_asked(self) -> None:
        """
        End the training if a signal has asked for it.

        :raises KeyboardInterrupt: after Ctrl-C
        :raises SystemExit: after SIGTERM
        """
        number = self.signals.noted
        if number is not None:
            self.signals.pass_on()
            self.signals.noted = None
            end_training(number, f"The training was interrupted: {self._kept_state}")

    @property
    def _kept_state(self) -> str:
        """The state that an interrupted training has, or the remedy."""
        if self._has_stepped and not self._is_in_rollouts and self.model._training.n_nested == 1:
            # Not by `learn`, which saves the state at the start, and repeats this training
            return "`train_policy` saves no state before its end; call it again to go on from the actor as it is"
        if not self.has_state:
            return "it has no state"
        return f"its state of step {self._saved_at} is in {self.path}; `resume` continues it"

    def release(self) -> None:
        """Restore the signals' handlers. Save no state until the next training starts, as this one may have failed."""
        self._has_stepped = False
        self._saving = []
        self.signals.release()


def checkpoints_among(callback: BaseCallback) -> list[TrainingCheckpointCallback]:
    """
    Return the callbacks that save states.

    :param callback: the training's callback
    :return: those among it and the callbacks within it
    """
    return [each for each in iter_callbacks(callback) if isinstance(each, TrainingCheckpointCallback)]
