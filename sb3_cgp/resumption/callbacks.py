"""A callback that saves the whole training state, so that a training that was stopped goes on as if it had not been."""

import os
import signal
import threading
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, NoReturn

from stable_baselines3.common.callbacks import BaseCallback

from sb3_cgp.common.rules import require, require_count
from sb3_cgp.resumption.state import check_replay_buffer, gather, restore
from sb3_cgp.resumption.store import StateStore

if TYPE_CHECKING:
    from sb3_cgp.resumption.algorithm import ResumableAlgorithm


class TrainingCheckpointCallback(BaseCallback):
    """
    Saves the whole training state every so many steps, and when the training ends, for :meth:`sb3_cgp.CGP.resume`.

    SB3 calls callbacks in the middle of a step. What is due is saved before the next rollout starts, when the step is over.

    On SIGTERM, as a cluster's scheduler sends it, the state is saved as soon as the step is over, and the process exits with
    status 143 (in offline policy training at once: its start was saved). A second SIGTERM acts as it would without this.
    Of several such callbacks, the first one does this.

    :param save_freq: environment steps between two states, those of all environments together
    :param path: the folder for the states. None saves nothing, unless rl_zoo3 is training: the run's folder, then.
    :param keep: how many states to keep, the newest ones
    :param verbose: Verbosity level: 0 for no output, 2 for indicating when a state is saved
    :raises ValueError: if an argument is out of its range, or, when the training starts, if the folder holds the states of
        another one, or the replay buffer cannot be saved
    :raises OSError: when the training starts or a state is due, if the folder cannot be written to
    """

    model: "ResumableAlgorithm"

    def __init__(self, save_freq: int, path: str | Path | None = None, keep: int = 2, verbose: int = 0):
        super().__init__(verbose)
        require_count("save_freq", save_freq)
        require_count("keep", keep)
        self.save_freq = save_freq
        self.path = path
        self.keep = keep
        self._saved_at = 0
        self._rollout_is_over = False
        self._is_in_rollouts = False
        self._previous_handler: Any = None
        self._watching_process = 0
        self._is_asked_to_stop = False

    @property
    def has_state(self) -> bool:
        """Whether there is a state to go on from."""
        return self.path is not None and len(StateStore(self.path).steps()) > 0

    def _on_training_start(self) -> None:
        self._is_in_rollouts = self._rollout_is_over = False
        self._saved_at = self.num_timesteps
        if self.path is None:
            return
        # Offline policy training is a training of its own to callbacks
        if not self.model.is_training_policy:
            check_replay_buffer(self.model._ensure_replay_buffer())
            is_another = self.has_state and self._folder not in self.model.saved_to
            allowed = "a folder without the states of another training: go on with that by `CGP.resume`, or choose another"
            require(not is_another, "path", str(self.path), allowed)
            self._store = StateStore(self._folder, self.keep)
            self._store.prepare()
        self._watch_for_termination()

    @property
    def _folder(self) -> Path:
        assert self.path is not None
        return Path(self.path).resolve()

    def _on_rollout_start(self) -> None:
        self._is_in_rollouts = True
        self._restore_if_resumed()
        if self.path is None:
            return
        if self._is_asked_to_stop:
            if self.num_timesteps > self._saved_at or not self.has_state:
                self._save()
            self._stop()
        if self.num_timesteps // self.save_freq > self._saved_at // self.save_freq:
            self._save()

    def _on_step(self) -> bool:
        self._rollout_is_over = False
        if self._is_asked_to_stop and not self._is_in_rollouts:
            self._stop()
        return True

    def _on_rollout_end(self) -> None:
        self._rollout_is_over = True

    def _on_training_end(self) -> None:
        self._restore_if_resumed()
        # A callback may have ended the training in the middle of a step; rl_zoo3 calls this twice, and after an error
        if self.path is not None and self._rollout_is_over:
            self._rollout_is_over = False
            self._save()
        self.release()
        # During the last step or its saving; what follows `learn` could take as long as the training
        if self._is_asked_to_stop:
            self._stop()

    def get_training_state(self) -> dict[str, int]:
        """
        Tell what a resumed training's callback goes on counting.

        :return: its counters
        """
        return {"n_calls": self.n_calls, "num_timesteps": self.num_timesteps}

    def set_training_state(self, state: dict[str, int]) -> None:
        """
        Go on counting.

        :param state: the counters
        """
        self.n_calls, self.num_timesteps = state["n_calls"], state["num_timesteps"]

    def _restore_if_resumed(self) -> None:
        if self.model.resumption is not None:
            restore(self.model, self.model.callback, self.model.resumption)
            self.model.resumption = None
            self._saved_at = self.num_timesteps = self.model.num_timesteps

    def _save(self) -> None:
        self._saved_at = self.num_timesteps
        settings = {"save_freq": self.save_freq, "keep": self.keep, "verbose": self.verbose}
        state = gather(self.model, self.model.callback)
        self._store.save(self.num_timesteps, state | {"checkpoint": settings})
        self.model.saved_to |= {self._folder}
        if self.verbose >= 2:
            print(f"Saving the training state of step {self.num_timesteps} to {self.path}")

    def _watch_for_termination(self) -> None:
        self._is_asked_to_stop = False
        handler = signal.getsignal(signal.SIGTERM)
        is_watched = isinstance(getattr(handler, "__self__", None), TrainingCheckpointCallback)
        # Python allows it in the main thread alone, and a handler that is not Python's (None) could not be put back
        if threading.current_thread() is threading.main_thread() and handler is not None and not is_watched:
            self._watching_process = os.getpid()
            self._previous_handler = signal.signal(signal.SIGTERM, self._note_termination)

    def _note_termination(self, number: int, frame: FrameType | None) -> None:
        self.release()
        if os.getpid() == self._watching_process:
            self._is_asked_to_stop = True
        else:
            # Forked off during the training, as by a simulator: such a process ends as it would without this
            os.kill(os.getpid(), number)

    def _stop(self) -> NoReturn:
        self._is_asked_to_stop = False
        raise SystemExit(128 + signal.SIGTERM)

    def release(self) -> None:
        """Let SIGTERM act as it did before the training."""
        if self._previous_handler is not None:
            signal.signal(signal.SIGTERM, self._previous_handler)
            self._previous_handler = None
