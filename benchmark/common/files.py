"""Writing results, as whole files, reading them, and the names of files."""

import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from sb3_cgp.common.files import write_atomically

# What a user can do about the damaged record of a training
RETRAIN = "Move it away, and give the same command again, which trains its run anew."


def write_json(path: Path, record: dict[str, Any]) -> None:
    """
    Write a record.

    :param path: the file
    :param record: the content; objects that JSON does not know are written as strings
    """
    write_atomically(path, (json.dumps(record, indent=2, default=str) + "\n").encode())


def read_json(path: Path, keys: Iterable[str] = (), remedy: str = "") -> dict[str, Any]:
    """
    Read a record.

    :param path: the file
    :param keys: keys that it must have
    :param remedy: what the user can do about a damaged file, a sentence
    :return: the content
    :raises ValueError: if the content is no mapping with these keys; it names the file, the line and the remedy
    """
    return parse_json(path.read_bytes(), path, keys, remedy)


def parse_json(
    text: bytes, path: Path, keys: Iterable[str] = (), remedy: str = "", first_line: int | None = None
) -> dict[str, Any]:
    """
    Return the record that a text in JSON holds.

    :param text: the text, in UTF-8
    :param path: the file that it is of, for errors
    :param keys: keys that the record must have
    :param remedy: what the user can do about a damaged file, a sentence
    :param first_line: the line of the file where the text begins; None for the whole file
    :return: the record
    :raises ValueError: if the text is no mapping with these keys; it names the file, the line and the remedy
    """
    place = str(path) if first_line is None else f"{path}, line {first_line},"
    try:
        record = json.loads(text)
    except json.JSONDecodeError as error:
        line = (first_line or 1) + error.lineno - 1
        raise ValueError(f"{path}, line {line}, is no JSON: {error.msg}. {remedy}".rstrip()) from error
    except UnicodeDecodeError as error:
        raise ValueError(f"{place} is no text in UTF-8. {remedy}".rstrip()) from error
    if not isinstance(record, dict):
        raise ValueError(f"{place} must hold a mapping in JSON, and holds {record!r:.60}. {remedy}".rstrip())
    missing = [key for key in keys if key not in record]
    if missing:
        raise ValueError(f"{place} lacks {', '.join(missing)}. {remedy}".rstrip())
    return record


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
