"""Locks on the folders of runs: a process that was taken for lost may still write to them."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from sb3_cgp.resumption.locks import FolderInUseError, FolderLock


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
            lock = FolderLock(folder)
            try:
                lock.acquire()
            except FolderInUseError:
                print(f"Waiting for {lock.read_owner()}, which may be suspended, to leave {folder}", flush=True)
                lock.wait()
            stack.callback(lock.release)
        yield
