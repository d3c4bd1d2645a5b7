"""Writing results, as whole files, and the names of files."""

import json
import re
from pathlib import Path
from typing import Any

from sb3_cgp.common.files import write_atomically


def write_json(path: Path, record: dict[str, Any]) -> None:
    """
    Write a record.

    :param path: the file
    :param record: the content; objects that JSON does not know are written as strings
    """
    write_atomically(path, (json.dumps(record, indent=2, default=str) + "\n").encode())


def file_name(text: str) -> str:
    """
    Return the name of a file or a folder for a text; different texts have different names.

    :param text: the text, such as an environment's id or a configuration
    :return: the text with slashes, backslashes, colons and percent signs percent-encoded
    """
    return re.sub(r"[%/\\:]", lambda found: f"%{ord(found[0]):02X}", text)


def publish(folder: Path, name: str, record: dict[str, Any], text: str | None) -> None:
    """
    Write the measurements of a command, and print them.

    :param folder: the folder of the files
    :param name: the files' name, without an extension
    :param record: the measurements, which are written as JSON
    :param text: the page in Markdown; None for no page
    """
    write_json(folder / f"{name}.json", record)
    if text is not None:
        write_atomically(folder / f"{name}.md", text.encode())
        print(text)
