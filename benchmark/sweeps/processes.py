"""Processes that work for another: how they are started, are told to end, and heed it."""

import argparse
import os
import signal
import subprocess
from collections.abc import Sequence
from pathlib import Path
from types import FrameType

from benchmark.common.arguments import count
from benchmark.sweeps.heartbeats import BEAT, GRACE
from benchmark.sweeps.storages import DEFAULT_STORAGE

# The exit code of a process that was told to end
TERMINATED = 128 + signal.SIGTERM


def add_workers(parser: argparse.ArgumentParser, logs: str) -> None:
    """
    Let a command line say where a study is, and what works it off.

    :param parser: the command's parser
    :param logs: where the runs go by default
    """
    parser.add_argument(
        "--storage", default=DEFAULT_STORAGE, help="a database's URL, or grpc://host:port (default: %(default)s)"
    )
    parser.add_argument("--workers", type=count, default=1, help="processes on this machine (default: %(default)s)")
    parser.add_argument("--threads", type=count, help="PyTorch's threads in each (default: the cores' share)")
    parser.add_argument("--device", default="auto", help="where the networks compute (default: %(default)s)")
    parser.add_argument("--logs", type=Path, default=Path(logs), help="where the runs go (default: %(default)s)")
    add_heartbeats(parser)


def add_heartbeats(parser: argparse.ArgumentParser) -> None:
    """
    Let a command line say how a process that was killed is noticed.

    :param parser: the command's parser
    """
    parser.add_argument("--beat", type=float, default=BEAT, help="seconds between two heartbeats (default: %(default)s)")
    parser.add_argument(
        "--grace", type=float, default=GRACE, help="seconds until a silent process is given up (default: %(default)s)"
    )


def see_that_grace_is_longer(beat: float, grace: float) -> None:
    """
    See that a living process is not taken for a silent one.

    :param beat: seconds between two heartbeats
    :param grace: seconds until a silent process is given up
    :raises ValueError: if the grace is no longer than two heartbeats
    """
    if not 0 < 2 * beat < grace:
        raise ValueError(f"The value of `grace` is {grace}, but must be more than two heartbeats of {beat} seconds")


def share_of_cores(n_workers: int) -> int:
    """
    Share the machine's cores out.

    :param n_workers: number of processes
    :return: threads for each
    """
    return max((os.cpu_count() or 1) // n_workers, 1)


def start_workers(command: Sequence[str], n_workers: int, threads: int, folder: Path) -> list[subprocess.Popen[bytes]]:
    """
    Start processes that train.

    :param command: the command line of each
    :param n_workers: how many
    :param threads: each one's threads
    :param folder: where their logs go
    :return: the processes
    """
    folder.mkdir(parents=True, exist_ok=True)
    # A library's threads are counted when it is loaded
    environment = {**os.environ, "OMP_NUM_THREADS": str(threads)}
    workers = []
    for number in range(n_workers):
        with open(folder / f"worker-{number}.log", "ab") as log:
            workers.append(subprocess.Popen(command, stdout=log, stderr=log, stdin=subprocess.DEVNULL, env=environment))
    return workers


def stop(workers: Sequence[subprocess.Popen[bytes]]) -> None:
    """
    Let processes save their runs' states, and end.

    :param workers: the processes
    """
    for worker in workers:
        if worker.poll() is None:
            worker.send_signal(signal.SIGTERM)
    try:
        for worker in workers:
            worker.wait()
    except KeyboardInterrupt:
        # Asked a second time
        for worker in workers:
            worker.kill()


def terminate(number: int, frame: FrameType | None) -> None:
    """
    End as a process that was told to.

    :param number: the signal
    :param frame: where the process was
    :raises SystemExit: always
    """
    raise SystemExit(128 + number)


def _terminate_as_asked(number: int, frame: FrameType | None) -> None:
    signal.raise_signal(signal.SIGTERM)


def listen(parent: int | None) -> None:
    """
    Heed signals as a process does that trains: SIGTERM has its run saved and given back.

    :param parent: the process that started this one, if one did
    """
    signal.signal(signal.SIGTERM, terminate)
    # Ctrl-C in a terminal reaches all of its processes: this one's parent tells it to end. Without one it is to give its run
    # back: rl_zoo3 takes Ctrl-C for a training's end.
    signal.signal(signal.SIGINT, _terminate_as_asked if parent is None else signal.SIG_IGN)
