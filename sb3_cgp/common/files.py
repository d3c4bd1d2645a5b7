"""Write files as a whole: first under another name, then onto the disk, and only then under their own name."""

import errno
import os
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

# The prefix of the names of files that are not complete yet
PARTIAL = ".partial-"
# Errors of file systems that cannot flush a folder, and write its names by themselves
NO_FOLDER_SYNC = (errno.EBADF, errno.EINVAL, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP)


@contextmanager
def whole_file(path: Path) -> Iterator[BinaryIO]:
    """
    Write a file so that readers see the old or the new content, never a part of it, also after a crash.

    Through a symbolic link, the file that it points to is written. A file that exists keeps its permissions.

    :param path: the file; its folder is made if it is missing
    :return: the file to write to, which replaces the old one at the end unless there was an error
    :raises OSError: if it cannot be written, as on a full disk; it names the file, and the old one is still there
    """
    # `os.replace` would replace a link itself
    path, given = Path(os.path.realpath(path)), path
    beside = _beside(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(beside, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        _keep_mode(path, beside)
        os.replace(beside, path)
    except OSError as error:
        raise _not_written(error, given) from error
    finally:
        _remove(beside)
    sync_folder(path.parent)


def write_atomically(path: Path, content: bytes | memoryview) -> None:
    """
    Write a file as :func:`whole_file` does.

    :param path: the file
    :param content: the content
    :raises OSError: if it cannot be written; it names the file, and the old one is still there
    """
    with whole_file(path) as file:
        file.write(content)


def replace_all(folder: Path, contents: Mapping[str, bytes | memoryview]) -> None:
    """
    Write files of one folder, each of which appears as a whole.

    All are on the disk before the first is renamed, and they are renamed in order. If the last one holds the checksums of the
    others, a mix of old and new files, which a crash between two renamings leaves, can be recognised.

    :param folder: the folder; it is made if it is missing
    :param contents: the files' contents by name
    :raises OSError: if one cannot be written; it names the file, and the old ones are still there
    """
    folder.mkdir(parents=True, exist_ok=True)
    paths = {name: Path(os.path.realpath(folder / name)) for name in contents}
    beside = {name: _beside(path) for name, path in paths.items()}
    name = ""
    try:
        for name, content in contents.items():
            with open(beside[name], "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
        for name, path in beside.items():
            _keep_mode(paths[name], path)
            os.replace(path, paths[name])
    except OSError as error:
        raise _not_written(error, folder / name) from error
    finally:
        for path in beside.values():
            _remove(path)
    sync_folder(folder)


def _beside(path: Path) -> Path:
    return path.with_name(f"{PARTIAL}{os.getpid()}-{path.name}")


def _keep_mode(path: Path, beside: Path) -> None:
    # A file system without permissions is no reason to write nothing
    with suppress(OSError):
        os.chmod(beside, stat.S_IMODE(path.stat().st_mode))


def _remove(path: Path) -> None:
    # The file may not exist, and an error here must not hide the cause
    with suppress(OSError):
        path.unlink()


def _not_written(error: OSError, path: Path) -> OSError:
    return OSError(error.errno or errno.EIO, f"{error.strerror or error}, so that this was not written", str(path))


def sync_folder(folder: Path) -> None:
    """
    Write the names of a folder's files to the disk.

    :param folder: the folder
    :raises OSError: if the disk refuses; not where the file system knows no such operation
    """
    # Windows can open no folders, and need not
    if os.name == "posix":
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        except OSError as error:
            if error.errno not in NO_FOLDER_SYNC:
                raise OSError(error.errno, error.strerror, str(folder)) from error
        finally:
            os.close(descriptor)
