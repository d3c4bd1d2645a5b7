"""Runs with several seeds that have a record each in a folder, as a table or a figure takes all of them together."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from benchmark.common.files import RETRAIN, read_json


def read_runs(folder: Path, keys: Iterable[str]) -> dict[Path, dict[str, Any]]:
    """
    Read the records of finished runs.

    :param folder: the folder of the records
    :param keys: keys that each must have
    :return: the records by file
    :raises ValueError: if one is damaged; it names the file and the remedy
    """
    # A killed process leaves files whose names begin with a dot
    return {path: read_json(path, keys, RETRAIN) for path in folder.glob("[!.]*_seed*.json")}


def check_settings(folder: Path, found: Mapping[str, Any], asked: Mapping[str, Any]) -> None:
    """
    Check that a finished run has the settings of the command line, as it is not repeated.

    :param folder: the folder of the records
    :param found: the run's settings by name
    :param asked: those of the command line
    :raises ValueError: if some differ; it names them and the remedy
    """
    other = {name: value for name, value in found.items() if value != asked.get(name)}
    if other:
        asked_in_words = ", ".join(f"{name}={asked.get(name)!r}" for name in other)
        found_in_words = ", ".join(f"{name}={value!r}" for name, value in other.items())
        raise ValueError(f"{folder} holds runs with {found_in_words}: choose another --folder for {asked_in_words}")
