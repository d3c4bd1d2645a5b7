"""The attributes of a model that describe its running training. The callback that saves training states uses them."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_cgp.resumption.callback_states import Start
from sb3_cgp.resumption.locks import FolderLock
from sb3_cgp.resumption.signals import StopSignals

State = dict[str, Any]
# The attributes below, which describe a running training and are not part of SB3's zip
UNSAVED = (
    *("callback", "resumption", "saved_to", "_folder_locks", "_n_nested_trainings", "_warned_of", "_initial_callbacks"),
    *("_outer_signals", "_added_checkpoint"),
)
# Those that a copy does not have, as it does not take part in the running training
UNCOPIED = ("callback", "_folder_locks", "_initial_callbacks", "_outer_signals", "_added_checkpoint")


class ResumableModel(OffPolicyAlgorithm):
    """The attributes and methods of a model whose training states can be saved."""

    # The callbacks of the training that is running
    callback: BaseCallback | None = None
    # The attributes of the callbacks at the training's start, by `id`
    _initial_callbacks: Mapping[int, Start] = MappingProxyType({})
    # The loaded state, until the next `learn` has restored it
    resumption: State | None = None
    # The digests of the states' manifests in each folder that holds states of this training
    saved_to: Mapping[Path, frozenset[str]] = MappingProxyType({})
    # `num_timesteps` at the start of the last call of `learn`
    _training_started_at: int = 0
    # The locks that this training holds
    _folder_locks: Mapping[Path, FolderLock] = MappingProxyType({})
    # A policy's offline training may run within `learn`
    _n_nested_trainings: int = 0
    # The callback that saves states in a resumed training without one among its callbacks
    _added_checkpoint: BaseCallback | None = None
    # The signals of the training in one of whose callbacks this one runs
    _outer_signals: StopSignals | None = None
    # The warnings about the training state that were given in this training
    _warned_of: frozenset[str] = frozenset()

    def get_training_state(self) -> State:
        """
        Return the state that SB3's zip does not hold, as plain data. Subclasses add to what ``super()`` returns.

        It is called before the zip and the pending log are copied, so that a model may update both in this method.

        :return: the state: None, numbers, strings, arrays, tensors, lists, tuples and dictionaries
        """
        inherited = getattr(super(), "get_training_state", dict)
        return inherited()

    def set_training_state(self, state: State) -> None:
        """
        Restore the state that :meth:`get_training_state` returned. Subclasses extend it by ``super()``.

        :param state: the state
        """
        inherited = getattr(super(), "set_training_state", None)
        if inherited is not None:
            inherited(state)

    def hold_folder(self, folder: Path) -> None:
        """
        Lock a folder of training states for this model. Do nothing if the model holds the lock already.

        :param folder: the folder, as an absolute path
        :raises FolderInUseError: if another training holds it
        """
        held = self._folder_locks.get(folder)
        if held is None or not held.is_ours:
            lock = FolderLock(folder)
            lock.acquire()
            self._folder_locks = {**self._folder_locks, folder: lock}

    def release_folders(self) -> None:
        """Release all folders of training states that the model holds."""
        for lock in self._folder_locks.values():
            lock.release()
        self._folder_locks = {}

    def _ensure_replay_buffer(self) -> ReplayBuffer:
        """Return the replay buffer, which SB3's algorithms allocate in their constructor and in `load`."""
        ensure = getattr(super(), "_ensure_replay_buffer", None)
        if ensure is not None:
            return ensure()
        assert self.replay_buffer is not None
        return self.replay_buffer

    def __getstate__(self) -> State:
        # Python has a method of this name since 3.11
        inherited = getattr(super(), "__getstate__", None)
        state = vars(self) if inherited is None else inherited()
        kept = {name: value for name, value in state.items() if name not in UNCOPIED}
        return kept | {"_n_nested_trainings": 0}

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), *UNSAVED]
