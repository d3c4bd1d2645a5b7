"""The names of the sweeps that come with the project. This module imports nothing that takes time."""

import re
import sys
from collections.abc import Sequence
from pathlib import Path

METHODS_FILE = "methods.yml"


def sweeps_folder() -> Path:
    """
    Return the folder of the paper's sweeps.

    :return: the folder, which is beside the package ``benchmark``
    """
    return Path(__file__).resolve().parents[2] / "hyperparams" / "sweeps"


def sweep_names() -> list[str]:
    """
    Return the names of the sweeps.

    :return: the names, e2 before e10
    """
    return sorted((each.stem for each in sweeps_folder().glob("*.yml") if each.name != METHODS_FILE), key=_with_numbers)


def sweep_path(name: str) -> Path:
    """
    Return the path that a sweep's file must have.

    :param name: the sweep's name, or the path of a file
    :return: the path, whether the file exists or not
    """
    return Path(name) if name.endswith((".yml", ".yaml")) else sweeps_folder() / f"{name}.yml"


def problem_of(name: str) -> str | None:
    """
    Return why a name stands for no sweep.

    :param name: the sweep's name, or the path of a file
    :return: what is wrong and what is allowed; None for a sweep
    """
    path = sweep_path(name)
    if path.is_file() and path.name != METHODS_FILE:
        return None
    return f"no such sweep: must be one of {', '.join(sweep_names())}, or the path of a .yml file"


def refuse_unknown_sweep(argv: Sequence[str]) -> None:
    """
    End the process if the command line begins with a name of no sweep.

    :param argv: the command line. An option before the name leaves the judgement to the command's parser.
    :raises SystemExit: naming the sweeps
    """
    if argv and not argv[0].startswith("-") and (problem := problem_of(argv[0])) is not None:
        sys.exit(f"Error: {argv[0]}: {problem}")


def _with_numbers(name: str) -> list[str | int]:
    """Return a key by which e2 comes before e10."""
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", name)]
