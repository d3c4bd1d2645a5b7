"""Steps of a list: commands that are executed in order within a time limit, and recorded, so that a later call continues."""

import argparse
import signal
import subprocess
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmark.common.files import read_json, write_json
from benchmark.common.measuring import TIME_OVER

ROOT = Path(__file__).parents[2]
# Seconds that a step is given to save its state and to end
TO_END = 45.0
# States of a step in the list's record
DONE, FAILED, STOPPED = "done", "failed", "stopped"
RECORD = "gpu_list.json"

Execute = Callable[[Sequence[str], Path, float], int]


@dataclass(frozen=True)
class Step:
    """
    A step of the list.

    :param name: its name, and that of its log
    :param command: the command line, after Python's name
    :param takes_minutes: whether the command has the option ``--minutes``
    :param continues: whether the command, once stopped, goes on from what it has written
    """

    name: str
    command: tuple[str, ...]
    takes_minutes: bool = False
    continues: bool = True

    def recorded(self, record: dict[str, Any]) -> dict[str, Any]:
        """
        Return what a record says of this step.

        :param record: the list's record
        :return: its entry, empty if there is none, or if it is of another command
        """
        entry: dict[str, Any] = record.get(self.name, {})
        return entry if entry.get("command") == list(self.command[1:]) else {}


def execute(command: Sequence[str], log: Path, seconds: float) -> int:
    """
    Execute a command for a time, after which it is asked to end, and then ended.

    :param command: the command line
    :param log: the file that its output is appended to
    :param seconds: the time
    :return: its exit code, :data:`TIME_OVER` if it was stopped
    """
    with log.open("ab") as output:
        process = subprocess.Popen(command, cwd=ROOT, stdout=output, stderr=subprocess.STDOUT)
        try:
            return process.wait(seconds)
        except subprocess.TimeoutExpired:
            return TIME_OVER
        finally:
            # Also where this process is interrupted, so that no step goes on without the list
            end(process)


def end(process: subprocess.Popen[bytes]) -> None:
    """
    Ask a process to end, and end it if it does not within :data:`TO_END` seconds.

    :param process: the process, which may have ended
    """
    if process.poll() is not None:
        return
    try:
        # A sweep saves its runs' states
        process.send_signal(signal.SIGTERM)
        process.wait(TO_END)
    except subprocess.TimeoutExpired:
        pass
    finally:
        process.kill()
        process.wait()


def do_steps(steps: Sequence[Step], args: argparse.Namespace, execute: Execute = execute) -> dict[str, Any]:
    """
    Do the steps that are left, in order, until the time is over. The record is written after each of them.

    :param steps: the steps
    :param args: the command line of ``benchmark.gpu_list``
    :param execute: executes a command: the command line, the log, and the seconds that it may take
    :return: the record: state, seconds and exit code of each step that was begun
    """
    start = time.monotonic()
    limit = float("inf") if args.minutes is None else 60 * args.minutes - TO_END
    record = read_record(args)
    is_first = True
    for step in steps:
        earlier = step.recorded(record)
        state = earlier.get("state")
        if state == DONE or (state == FAILED and not args.retry) or (args.only is not None and step.name not in args.only):
            print(f"{step.name}: {state or 'left out'}", flush=True)
            continue
        begin = time.monotonic()
        left = limit - (begin - start)
        if left <= 0:
            print("The time is over. The same command continues.")
            break
        command = list(step.command)
        if step.takes_minutes and args.minutes is not None:
            # Half a minute less, as a point that has begun is finished
            command += ["--minutes", f"{max(left / 60 - 0.5, 0.0):.2f}"]
        print(f"{step.name}: {' '.join(command[1:])}", flush=True)
        code = execute(command, args.folder / f"{step.name}.log", left)
        state = DONE if code == 0 else STOPPED if code == TIME_OVER else FAILED
        if state == STOPPED and is_first and not step.continues:
            # It had all of the time, and would take that of each further call
            state = FAILED
            print(f"{step.name} needs more time: give more --minutes, and --retry.")
        is_first = False
        seconds = earlier.get("seconds", 0.0) + time.monotonic() - begin
        # Without its minutes, by which calls differ
        entry = {"state": state, "seconds": round(seconds, 1), "exit_code": code, "command": list(step.command[1:])}
        record[step.name] = entry
        write_json(args.folder / RECORD, record)
        print(f"{step.name}: {state} after {seconds:.0f} s, see {args.folder / step.name}.log", flush=True)
    return record


def read_record(args: argparse.Namespace) -> dict[str, Any]:
    """
    Return the list's record of earlier calls.

    :param args: the command line of ``benchmark.gpu_list``
    :return: the record, empty if there is none
    :raises ValueError: if it is damaged; it names the file and the remedy
    """
    path = args.folder / RECORD
    remedy = "Move it away, and give the same command again: each step goes on from what it has written."
    return read_json(path, remedy=remedy) if path.exists() else {}
