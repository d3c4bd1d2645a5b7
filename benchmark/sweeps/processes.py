"""Processes that train: the arguments on them, and how a command starts and stops them."""

import argparse
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from benchmark.common.arguments import count, device_name, output_folder
from benchmark.sweeps.heartbeats import BEAT, GRACE
from benchmark.sweeps.storages import DEFAULT_STORAGE
from sb3_cgp.population.processes import available_cores

# Seconds between two reads of a study by the command that has started its workers
INTERVAL = 2.0
# Seconds between two reads of a study of which nothing waits
PAUSE = 2.0


def add_workers(parser: argparse.ArgumentParser, logs: str) -> None:
    """
    Add the arguments on the storage of a study, and on the processes that train its runs.

    :param parser: the command's parser
    :param logs: the default folder of the runs
    """
    parser.add_argument(
        "--storage", default=DEFAULT_STORAGE, help="a database's URL, or grpc://host:port (default: %(default)s)"
    )
    parser.add_argument(
        "--gym-packages",
        nargs="+",
        action="extend",
        default=[],
        help="modules to import, which register environments, as in rl_zoo3",
    )
    parser.add_argument("--workers", type=count, default=1, help="processes on this machine (default: %(default)s)")
    parser.add_argument("--threads", type=count, help="PyTorch's threads in each (default: the cores' share)")
    parser.add_argument("--device", type=device_name, default="auto", help="device of the networks (default: %(default)s)")
    parser.add_argument("--logs", type=output_folder, default=Path(logs), help="folder of the runs (default: %(default)s)")
    add_heartbeats(parser)


def add_heartbeats(parser: argparse.ArgumentParser) -> None:
    """
    Add the arguments on heartbeats, by which a process that was killed is noticed.

    :param parser: the command's parser
    """
    parser.add_argument("--beat", type=float, default=BEAT, help="seconds between two heartbeats (default: %(default)s)")
    parser.add_argument(
        "--grace",
        type=float,
        default=GRACE,
        help="seconds of silence after which a process is taken for lost (default: %(default)s)",
    )


def check_grace(beat: float, grace: float) -> None:
    """
    Check that a living process is not taken for a lost one.

    :param beat: seconds between two heartbeats
    :param grace: seconds of silence after which a process is taken for lost
    :raises ValueError: if the grace is no longer than two heartbeats
    """
    if not 0 < 2 * beat < grace:
        raise ValueError(f"The value of `grace` is {grace}, but must be more than two heartbeats of {beat} seconds")


def share_of_cores(n_workers: int) -> int:
    """
    Divide the cores that this process may use among processes.

    :param n_workers: number of processes
    :return: threads for each
    """
    return max(available_cores() // n_workers, 1)


def start_workers(command: Sequence[str], n_workers: int, threads: int, folder: Path) -> list[subprocess.Popen[bytes]]:
    """
    Start processes that train runs.

    :param command: the command line of each
    :param n_workers: number of processes
    :param threads: threads of each
    :param folder: folder of their logs
    :return: the processes
    """
    folder.mkdir(parents=True, exist_ok=True)
    if n_workers > 0:
        noun = "worker" if n_workers == 1 else "workers"
        print(f"Starting {n_workers} {noun}, whose logs are {folder}/worker-*.log", file=sys.stderr, flush=True)
    # OpenMP reads this when it is loaded
    environment = {**os.environ, "OMP_NUM_THREADS": str(threads)}
    workers = []
    for number in range(n_workers):
        with open(folder / f"worker-{number}.log", "ab") as log:
            workers.append(subprocess.Popen(command, stdout=log, stderr=log, stdin=subprocess.DEVNULL, env=environment))
    return workers


@contextmanager
def stopping(workers: Sequence[subprocess.Popen[bytes]]) -> Iterator[None]:
    """
    End processes if the ``with`` block ends by an error or a signal, and say how to continue.

    :param workers: the processes
    """
    try:
        yield
    except BaseException:
        _stop(workers)
        print("Stopped. The same command continues.", file=sys.stderr)
        raise


def _stop(workers: Sequence[subprocess.Popen[bytes]]) -> None:
    """End processes, which save the states of their runs before."""
    for worker in workers:
        if worker.poll() is None:
            worker.send_signal(signal.SIGTERM)
    try:
        for worker in workers:
            worker.wait()
    except KeyboardInterrupt:
        # Ctrl-C a second time
        for worker in workers:
            worker.kill()
