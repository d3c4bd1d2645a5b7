"""Checking an environment: the parts of ``check.py`` as processes of the package's virtual environment, and what they say."""

import json
import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmark.common.files import write_json
from benchmark.compatibility.package_types import Environment
from benchmark.compatibility.processes import execute
from benchmark.compatibility.texts import in_a_line

SCRIPT = Path(__file__).with_name("check.py")
# Without a display
HEADLESS = {"SDL_VIDEODRIVER": "dummy", "MPLBACKEND": "agg"}


def check(environment: Environment, python: Path, folder: Path, timeout: float, reuse: bool = False) -> dict[str, Any]:
    """
    Train, predict, save, load, export, stop, resume, and, where it is declared, learn.

    :param environment: the environment
    :param python: the interpreter of the package's virtual environment
    :param folder: for the files of the check, which is emptied
    :param timeout: seconds for each part
    :param reuse: whether the folder of an interrupted check is kept, and the parts that it has completed are not repeated
    :return: the row of the environment, see :func:`summary`
    """
    declared, declaration = folder / "environment.json", json.dumps(asdict(environment))
    if not (reuse and declared.is_file() and declared.read_text() == declaration):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        declared.write_text(declaration)
    parts = ["whole", "stopped", "resumed", *(["learnt"] if environment.learning is not None else [])]
    found: dict[str, dict[str, Any]] = {}
    for part in parts:
        found[part] = _read(folder / f"{part}.json")
        if not found[part].get("complete"):
            (folder / f"{part}.json").unlink(missing_ok=True)
            command = [str(python), str(SCRIPT), part, str(folder)]
            ended = execute(command, folder, folder / f"{part}.log", timeout, HEADLESS)
            found[part] = _read(folder / f"{part}.json")
            if not ended.succeeded:
                # A simulator may crash when the interpreter ends
                last = "ends" if found[part].get("complete") else found[part].get("doing") or "starts"
                found[part]["errors"][last] = f"the process ended by {ended.reason}"
                # For a check that is continued, and does not repeat the part
                write_json(folder / f"{part}.json", found[part])
        # The same would stop the other parts
        if {"starts", "trains"} & found[part]["errors"].keys():
            break
    return summary(found)


def summary(found: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """
    Compare the parts.

    :param found: what each has written, by part
    :return: the errors and warnings of all; whether two trainings of one seed are the same bit for bit ("repeats"); how the
        training was resumed ("resumes": "bit for bit", "from a new episode", "differs", or None if it was not); and all other
        values as they were written
    """
    compared = ("at_stop", "at_end", "versions", "warnings", "errors", "doing", "complete")
    row = {key: _clean(value) for part in found.values() for key, value in part.items() if key not in compared}
    row["versions"] = found["whole"].get("versions", {})
    for key in ("errors", "warnings"):
        row[key] = {part: _clean(values[key]) for part, values in found.items() if values[key]}
    straight, stopped, resumed = (found.get(part, {}) for part in ("whole", "stopped", "resumed"))
    row["repeats"] = _same(straight, stopped, "at_stop")
    is_same = _same(straight, resumed, "at_end")
    if is_same is None:
        row["resumes"] = None
    elif row.get("why_not_restorable") is not None:
        row["resumes"] = "from a new episode"
    else:
        row["resumes"] = "bit for bit" if is_same else "differs"
    return row


def _read(path: Path) -> dict[str, Any]:
    """Return what a part has written."""
    return json.loads(path.read_text()) if path.is_file() else {"errors": {}, "warnings": []}


def _same(one: dict[str, Any], other: dict[str, Any], key: str) -> bool | None:
    """Return whether the hashes of two parts are the same, or None where one is missing."""
    if one.get(key) is None or other.get(key) is None:
        return None
    return bool(one[key] == other[key])


def _clean(value: Any) -> Any:
    """Return a value in which each text is a line without this machine's paths."""
    if isinstance(value, dict):
        return {key: _clean(each) for key, each in value.items()}
    if isinstance(value, list):
        return [_clean(each) for each in value]
    return in_a_line(value) if isinstance(value, str) else value
