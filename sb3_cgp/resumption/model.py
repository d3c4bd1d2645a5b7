"""The attributes of a model that describe its running training. The callback that saves training states uses them."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar

from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback

from sb3_cgp.common.transient import TransientAttributes
from sb3_cgp.resumption.callback_states import Start
from sb3_cgp.resumption.locks import FolderLock

State = dict[str, Any]


@dataclass(frozen=True)
class RunningTraining:
    """
    What a model has while it trains, and after ``resume``. The values without a training are the defaults.

    :param callback: the training's callbacks
    :param initial_callbacks: their attributes at the training's start, by `id`
    :param added_checkpoint: the callback that saves states in a resumed training without one among its callbacks
    :param folder_locks: the locks that the training holds
    :param n_nested: number of trainings in progress: 2 in a policy's offline training within `learn`
    :param warned_of: the warnings about the training state that were given
    :param checked_optimizers: the optimizers that a resumed training has, too, by name
    """

    callback: BaseCallback | None = None
    initial_callbacks: Mapping[int, Start] = field(default_factory=dict)
    added_checkpoint: BaseCallback | None = None
    folder_locks: Mapping[Path, FolderLock] = field(default_factory=dict)
    n_nested: int = 0
    warned_of: frozenset[str] = frozenset()
    checked_optimizers: Mapping[str, Any] = field(default_factory=dict)


class ResumableModel(TransientAttributes):
    """The attributes and methods of a model whose training states can be saved."""

    TRANSIENT: ClassVar[tuple[str, ...]] = ("_training",)
    _training = RunningTraining()
    # The loaded state, until the next `learn` has restored it
    resumption: State | None = None
    # The digests of the states' manifests in each folder that holds states of this training
    saved_to: Mapping[Path, frozenset[str]] = MappingProxyType({})
    # `num_timesteps` at the start of the last call of `learn`
    _training_started_at: int = 0
    # Whether the last training ended by itself or by a callback, not by a signal or an error
    _training_has_ended: bool = False

    def _note_training(self, **changes: Any) -> None:
        """Change what is known of the running training."""
        self._training = replace(self._training, **changes)

    def _before_saving_state(self) -> None:
        """Bring the attributes and the log up to date, before they are copied into a training state."""
        inherited = getattr(super(), "_before_saving_state", None)
        if inherited is not None:
            inherited()

    def hold_folder(self, folder: Path) -> None:
        """
        Lock a folder of training states for this model. Do nothing if the model holds the lock already.

        :param folder: the folder, as an absolute path
        :raises FolderInUseError: if another training holds it
        """
        held = self._training.folder_locks.get(folder)
        if held is None or not held.is_ours:
            lock = FolderLock(folder)
            lock.acquire()
            self._note_training(folder_locks={**self._training.folder_locks, folder: lock})

    def _forget_training(self) -> None:
        """Release all folders of training states that the model holds, and forget the training."""
        for lock in self._training.folder_locks.values():
            lock.release()
        self._training = RunningTraining()

    def _ensure_replay_buffer(self) -> ReplayBuffer:
        """Return the replay buffer, which SB3's algorithms allocate in their constructor and in `load`."""
        ensure = getattr(super(), "_ensure_replay_buffer", None)
        if ensure is not None:
            return ensure()
        assert self.replay_buffer is not None
        return self.replay_buffer

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "resumption", "saved_to"]
