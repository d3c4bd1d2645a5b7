"""The folder of a run of rl_zoo3, which belongs to one process at a time, and how an interrupted run is continued."""

import os
import shlex
import shutil
import sys
from pathlib import Path
from typing import Any

from sb3_cgp.resumption.locks import FolderLock
from sb3_cgp.resumption.store import StateStore

LOCK_FILE = ".run-lock"
# The locks that this process holds, by folder
_held: dict[Path, FolderLock] = {}


def hold_run(folder: str | Path) -> None:
    """
    Lock a run's folder for this process. Do nothing if this process has locked it already.

    The lock on the folder of states begins with the training, ends before the final model is saved, and is missing in a run
    without states.

    :param folder: the run's folder, which exists
    :raises FolderInUseError: if another process trains the run, naming its host and process
    """
    folder = Path(folder).resolve()
    if folder not in _held or not _held[folder].is_ours:
        lock = FolderLock(folder, LOCK_FILE)
        lock.acquire()
        _held[folder] = lock


def release_run(folder: str | Path) -> None:
    """
    Release a run's folder. Do nothing if this process does not hold it.

    :param folder: the run's folder
    """
    lock = _held.pop(Path(folder).resolve(), None)
    if lock is not None:
        lock.release()


def how_to_continue(folder: str | Path, states: str, model: Any, n_timesteps: int) -> str | None:
    """
    Return the lines that tell the user how an interrupted run is continued.

    :param folder: the run's folder
    :param states: the folder of its states
    :param model: its model
    :param n_timesteps: environment steps of the whole run
    :return: the lines; None if the run was not interrupted
    """
    if model._training_has_ended:
        return None
    stopped = f"The run was interrupted at step {model.num_timesteps:,} of {n_timesteps:,}."
    steps = StateStore(Path(states)).steps()
    if not steps:
        return f"{stopped} It cannot be continued, as no state of it was saved in {states}."
    command = f"{interpreter()} -m sb3_cgp.zoo.resume {shlex.quote(str(folder))}"
    return f"{stopped} Continue it, from step {max(steps):,}, by\n  {command}"


def interpreter() -> str:
    """Return the command that starts this process's interpreter: "python" where the shell finds it, or else its path."""
    executable, found = Path(sys.executable or "python"), shutil.which("python")
    # By the folder, too, as the interpreter of a virtual environment is a link to one outside of it
    if not executable.exists() or (
        found is not None and Path(found).parent == executable.parent and executable.samefile(found)
    ):
        return "python"
    relative = os.path.relpath(executable)
    # A shell does not look for a name without a folder in the working directory
    is_shorter = os.sep in relative and not relative.startswith(os.pardir)
    return shlex.quote(relative if is_shorter else str(executable))
