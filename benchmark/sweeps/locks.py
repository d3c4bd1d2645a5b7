"""Locks on the folders of runs: a process that was taken for lost may still write to them."""

import errno
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

# Of a file system without locks
NO_LOCKS = (errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOLCK)


@contextmanager
def locked(folders: Sequence[Path]) -> Iterator[None]:
    """
    Lock folders within a ``with`` block, and say for which process it waits. A file system may have no locks.

    :param folders: the folders, which are created
    """
    with ExitStack() as stack:
        # All processes in the same order, so that no two wait for each other
        for folder in sorted(folders):
            folder.mkdir(parents=True, exist_ok=True)
            path = folder / ".lock"
            # A file alone would remain where a process is killed, and all others would wait for it
            lock = FileLock(path, fallback_to_soft=False)
            try:
                lock.acquire(timeout=0)
            except Timeout:
                told = f"Waiting for the process that holds {path}, which may be suspended: `fuser {path}` names it"
                print(told, flush=True)
                lock.acquire()
            except OSError as error:
                if error.errno not in NO_LOCKS:
                    raise
                print(f"Warning: {folder} cannot be locked ({error}): make sure that no other process uses it.", flush=True)
                continue
            stack.callback(lock.release)
        yield
