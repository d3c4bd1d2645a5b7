"""Writing files: beside their place, onto the disk, and only then in their place."""

import errno
import os
from collections.abc import Mapping
from pathlib import Path

# What files are called until they are whole
PARTIAL = ".partial-"


def write_atomically(path: Path, content: bytes | memoryview) -> None:
    """
    Write a file so that whoever looks sees the old one or the new one, never a part, and after a crash too.

    :param path: the file
    :param content: what it shall hold
    :raises OSError: if it cannot be written, as on a full disk; it names the file, and the old one is still there
    """
    replace_all(path.parent, {path.name: content})


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
    beside = {name: folder / f"{PARTIAL}{os.getpid()}-{name}" for name in contents}
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
        reason = error.strerror or str(error)
        raise OSError(error.errno or errno.EIO, f"{reason}, so that this was not written", str(folder / name)) from error
    finally:
        for path in beside.values():
            path.unlink(missing_ok=True)
    sync_folder(folder)


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
