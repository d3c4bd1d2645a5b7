"""Saved files beside folders of the same name, such as a model's zip beside the folder that the model was exported to."""

import errno
import pathlib
from typing import Any

# The methods that read a folder, and what it holds, in the order of the error's text
READERS = {"load_weights": "an exported policy", "resume": "training states"}


def find_file(algorithm: type, path: Any, suffix: str) -> Any:
    """
    Return the file ``name.zip`` or ``name.pkl`` where ``name`` is a folder.

    SB3 adds the suffix only where ``name`` does not exist, and fails to open a folder.

    :param algorithm: the algorithm's class, whose methods that read folders are named in the error
    :param path: the path of a file with or without its suffix, or anything else, such as an open file
    :param suffix: the suffix, "zip" or "pkl"
    :return: the file beside a folder of that name; anything that is no path of a folder as it is
    :raises IsADirectoryError: if the path is a folder without a file of the same name beside it
    """
    if not isinstance(path, str | pathlib.Path) or not pathlib.Path(path).is_dir():
        return path
    file = pathlib.Path(f"{path}.{suffix}")
    if file.is_file():
        return file
    readers = [f"`{name}` reads a folder of {content}" for name, content in READERS.items() if hasattr(algorithm, name)]
    reason = "; ".join([f"Is a folder, and there is no file {file}", *readers])
    raise IsADirectoryError(errno.EISDIR, reason, str(path))
