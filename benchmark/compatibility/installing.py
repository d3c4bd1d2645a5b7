"""Installing a package into a virtual environment of its own, with the versions of ``constraints.txt`` where they agree."""

import json
import re
import shutil
import time
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from benchmark.compatibility.processes import Ended, execute
from benchmark.compatibility.texts import in_a_line
from sb3_cgp.common.files import write_atomically

# Pins that are kept where others contradict a package: PyTorch's, as another version may bring gigabytes for GPUs, and SB3's
KEPT = ("torch", "stable-baselines3")
CONFLICTS = ("ResolutionImpossible", "conflicting dependencies")
# Written into a virtual environment when it is complete
STAMP = "installed.json"


def read_pins(constraints: Path) -> dict[str, str]:
    """
    Read the pinned versions that hold for this Python.

    :param constraints: the file
    :return: versions by normalised name
    """
    pins: dict[str, str] = {}
    for line in constraints.read_text().splitlines():
        if line.strip() and not line.startswith("#"):
            requirement = Requirement(line)
            if requirement.marker is None or requirement.marker.evaluate():
                pins[canonicalize_name(requirement.name)] = str(requirement.specifier).removeprefix("==")
    return pins


def install(python: str, project: Path, requirements: tuple[str, ...], venv: Path, timeout: float) -> dict[str, Any]:
    """
    Install this project and a package's requirements into a new virtual environment, or find that they are installed.

    :param python: the interpreter that makes the environment
    :param project: the folder of this project's ``setup.cfg`` and ``constraints.txt``
    :param requirements: what pip installs
    :param venv: the environment's folder
    :param timeout: seconds for each of the two attempts
    :return: "pins", which are "all" of ``constraints.txt`` or the names in ``KEPT``, and "seconds"; or "failure", the reason
    """
    stamp, log = venv / STAMP, venv.with_suffix(".log")
    wanted = {"requirements": list(requirements)}
    if stamp.is_file() and (found := json.loads(stamp.read_text())).items() >= wanted.items():
        return {"pins": found["pins"], "seconds": found["seconds"]}
    shutil.rmtree(venv, ignore_errors=True)
    started = time.monotonic()
    ended = execute([python, "-m", "venv", str(venv)], project, log, timeout)
    if not ended.succeeded:
        return {"failure": failure(ended, log)}
    kept = venv / "constraints.txt"
    pins = read_pins(project / "constraints.txt")
    kept.write_text("".join(f"{name}=={pins[name]}\n" for name in KEPT))
    for names, constraints in (("all", project / "constraints.txt"), (list(KEPT), kept)):
        # Modules are compiled when they are imported, which few are
        options = ["--no-compile", "-c", str(constraints), "-e", ".[export]"]
        command = [str(venv / "bin" / "python"), "-m", "pip", "install", *options, *requirements]
        ended = execute(command, project, log, timeout)
        if ended.succeeded:
            installed = {"pins": names, "seconds": time.monotonic() - started}
            write_atomically(stamp, json.dumps(wanted | installed).encode())
            return installed
        if not any(words in log.read_text(errors="replace") for words in CONFLICTS):
            break
    return {"failure": failure(ended, log)}


def failure(ended: Ended, log: Path) -> str:
    """
    Return why an installation failed.

    :param ended: how its process ended
    :param log: what the process has written
    :return: the reason in a line
    """
    if ended.reason != "exit code 1":
        return f"the installation ended by {ended.reason}"
    errors = re.findall(r"^\s*(?:ERROR|error|fatal error): *(\S.*)$", log.read_text(errors="replace"), flags=re.MULTILINE)
    # pip's first line says what failed; the last one is about resolving in general, or repeats the first
    return in_a_line(errors[0] if errors else "pip ended with exit code 1 without an error message")
