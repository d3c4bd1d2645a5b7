"""Locks on folders of training states and of runs: a folder belongs to one training at a time."""

import errno
import gc
import os
import socket
import warnings
from contextlib import suppress
from pathlib import Path

from filelock import FileLock, Timeout

LOCK_FILE = ".lock"
# Of a file of its own, as some versions of filelock truncate the file that they lock
OWNER_SUFFIX = "-owner"
# Errors of a file system without locks, of which Linux has one (ENOTSUPP) that Python does not name
NO_LOCKS = (errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOLCK, errno.EINVAL, 524)
# Errors of a lock's file that another user has left
NOT_OURS = (errno.EACCES, errno.EPERM)


class FolderInUseError(RuntimeError):
    """Another training uses the folder."""


class FolderLock:
    """
    An exclusive lock on a folder.

    The operating system releases the lock when the process ends, even if it is killed. A forked process does not hold it.

    :param folder: the folder, which must exist
    :param name: the name of the file that is locked
    """

    def __init__(self, folder: Path, name: str = LOCK_FILE):
        self.folder = folder
        self._owner_file = folder / f"{name}{OWNER_SUFFIX}"
        # A model may be deleted in another thread than the one that it was resumed in. On a file system without locks, a file
        # alone would be in the way of a resumption after a kill, and of a copied folder. Other users lock the same file.
        self._lock = FileLock(folder / name, mode=0o666, thread_local=False, fallback_to_soft=False)
        self._process = os.getpid()

    @property
    def is_ours(self) -> bool:
        """Whether this process acquired the lock, and not one that this process was forked from."""
        return self._process == os.getpid()

    def acquire(self) -> None:
        """
        Acquire the lock, without waiting for it.

        A folder that cannot be written to needs no lock. On a file system without locks, or where the lock's file is another
        user's, a warning is given.

        :raises FolderInUseError: if another training holds it, naming its host and process
        :raises OSError: if it cannot be locked for another reason, such as too many open files
        """
        try:
            self._acquire(timeout=0)
        except Timeout:
            # A deleted model holds its lock until the garbage collector runs, as SB3's models are part of reference cycles
            gc.collect()
            try:
                self._acquire(timeout=0)
            except Timeout:
                raise FolderInUseError(
                    f"The folder {self.folder} is in use by another training: {self.read_owner()}. A folder belongs "
                    "to one training at a time. Wait for that training to end, stop it, or, if it is a model "
                    "in this process, delete that model."
                ) from None

    def wait(self) -> None:
        """
        Acquire the lock, after waiting for as long as another training holds it.

        :raises OSError: as :meth:`acquire` does
        """
        self._acquire(timeout=-1)

    def _acquire(self, timeout: float) -> None:
        try:
            self._lock.acquire(timeout)
        except Timeout:
            raise
        except OSError as error:
            # What else prevents writing to the folder is said where a state is written
            if not (self.folder.is_dir() and os.access(self.folder, os.W_OK)):
                return
            if error.errno not in (*NO_LOCKS, *NOT_OURS):
                raise
            warnings.warn(
                f"The folder {self.folder} cannot be locked ({error}): make sure that no other process uses it.",
                stacklevel=3,
            )
            return
        with suppress(OSError):
            # It may be another user's, of a process that was killed
            self._owner_file.unlink(missing_ok=True)
            self._owner_file.write_text(f"process {os.getpid()} on host {socket.gethostname()}")

    def read_owner(self) -> str:
        """Return the process and the host that hold the lock, in words."""
        try:
            return self._owner_file.read_text() or "an unknown process"
        except OSError:
            return "an unknown process"

    def release(self) -> None:
        """Release the lock. Do nothing if this process does not hold it."""
        if self.is_ours and self._lock.is_locked:
            with suppress(OSError):
                self._owner_file.unlink()
            self._lock.release(force=True)
