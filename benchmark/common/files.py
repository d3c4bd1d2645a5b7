"""Writing results: whole files or none, and Markdown for people beside JSON for programs."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sb3_cgp.common.files import write_atomically


def write_json(path: Path, record: dict[str, Any]) -> None:
    """
    Write a record.

    :param path: the file
    :param record: what it shall hold; what JSON does not know is written as a string
    """
    write_atomically(path, (json.dumps(record, indent=2, default=str) + "\n").encode())


def publish(folder: Path, name: str, record: dict[str, Any], text: str) -> None:
    """
    Write what a command measured, and show it.

    :param folder: where to write
    :param name: the files' name, without an extension
    :param record: what was measured, for programs
    :param text: the same in Markdown, for people
    """
    write_json(folder / f"{name}.json", record)
    write_atomically(folder / f"{name}.md", text.encode())
    print(text)


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """
    Lay out a table, its first column to the left and the others to the right.

    :param header: the columns' titles
    :param rows: the cells of each row
    :return: the table in Markdown
    """
    lines = [header, ["---"] + ["---:"] * (len(header) - 1), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
