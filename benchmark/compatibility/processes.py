"""Processes that may fail, crash or hang."""

import os
import signal
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Ended:
    """
    How a process ended.

    :param reason: "exit code 0", the name of a signal, or the time limit, in words
    """

    reason: str

    @property
    def succeeded(self) -> bool:
        """Whether the process did what it was asked."""
        return self.reason == "exit code 0"


def execute(
    command: Sequence[str], folder: Path, log: Path, timeout: float, environment: Mapping[str, str] | None = None
) -> Ended:
    """
    Execute a command in a process group of its own, all of which is ended at the time limit.

    :param command: the command
    :param folder: its working directory
    :param log: a file for what it writes
    :param timeout: the limit in seconds
    :param environment: variables to add to those of this process
    :return: how it ended
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    with open(log, "wb") as file:
        try:
            process = subprocess.Popen(
                command,
                cwd=folder,
                env={**os.environ, **(environment or {})},
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        except OSError as error:
            return Ended(f"{type(error).__name__}: {error.strerror}")
        try:
            code = process.wait(timeout)
        except BaseException as error:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            if isinstance(error, subprocess.TimeoutExpired):
                return Ended(f"the time limit of {timeout:g} seconds")
            raise
    return Ended(f"exit code {code}" if code >= 0 else signal.Signals(-code).name)
