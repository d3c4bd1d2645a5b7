"""Writing files: beside their place, onto the disk, and only then in their place."""

import errno
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

# What files are called until they are whole
PARTIAL = ".partial-"


@contextmanager
def whole_file(path: Path) -> Iterator[BinaryIO]:
    """
    Write a file so that whoever looks sees the old one or the new one, never a part, and after a crash too.

    :param path: the file; its folder is made if it is missing
    :return: where to write, which takes its place at the end unless there was an error
    :raises OSError: if it cannot be written, as on a full disk; it names the file, and the old one is still there
    """
    beside = _beside(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(beside, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(beside, path)
    except OSError as error:
        raise _not_written(error, path) from error
    finally:
        _remove(beside)
    sync_folder(path.parent)


def write_atomically(path: Path, content: bytes | memoryview) -> None:
    """
    Write a file as :func:`whole_file` does.

    :param path: the file
    :param content: what it shall hold
    :raises OSError: if it cannot be written; it names the file, and the old one is still there
    """
    with whole_file(path) as file:
        file.write(content)


def replace_all(folder: Path, contents: Mapping[str, bytes | memoryview]) -> None:
    """
    Write files of one folder, each of which appears as a whole.

    All are on the disk before the first takes its place, in their order: let the last one hold the others' checksums, and
    what a crash among the renamings leaves is recognised as a mix.

    :param folder: the folder; it is made if it is missing
    :param contents: the files' contents by name
    :raises OSError: if one cannot be written; it names the file, and the old ones are still there
    """
    folder.mkdir(parents=True, exist_ok=True)
    beside = {name: _beside(folder / name) for name in contents}
    name = ""
    try:
        for name, content in contents.items():
            with open(beside[name], "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
        for name, path in beside.items():
            os.replace(path, folder / name)
    except OSError as error:
        raise _not_written(error, folder / name) from error
    finally:
        for path in beside.values():
            _remove(path)
    sync_folder(folder)


def _beside(path: Path) -> Path:
    return path.with_name(f"{PARTIAL}{os.getpid()}-{path.name}")


def _remove(path: Path) -> None:
    # What is left over may not be there, and cannot hide why
    with suppress(OSError):
        path.unlink()


def _not_written(error: OSError, path: Path) -> OSError:
    return OSError(error.errno or errno.EIO, f"{error.strerror or error}, so that this was not written", str(path))


def sync_folder(folder: Path) -> None:
    """
    Put the names in a folder onto the disk.

    :param folder: the folder
    """
    # Windows opens no folders, nor does it need to
    if os.name == "posix":
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(folder)) from error
        finally:
            os.close(descriptor)
