"""
A process that works off a study: it claims a run, trains it, and claims the next, until all have ended.

``benchmark.sweep`` starts these; ``python -m benchmark.worker --help`` says how to start one by hand.
"""

import argparse
import os
import signal
import socket
import sys
import threading
import time
import traceback
from collections.abc import Sequence
from pathlib import Path
from types import FrameType
from typing import Any

import torch as th
from filelock import FileLock

from benchmark.arguments import count
from benchmark.run import forget_states, run_folder, train
from benchmark.storages import STORAGE_ERRORS, open_storage, patiently
from benchmark.studies import Claim, Ledger, TrialLostError

# Seconds between two heartbeats, and until a silent process is given up, by default
BEAT, GRACE = 5.0, 60.0
# Seconds between two looks at a study of which no run waits
PAUSE = 2.0
TERMINATED = 128 + signal.SIGTERM


class Heart:
    """
    A thread that tells a study, again and again, that this process is alive, and sees whether it should be.

    :param ledger: the study
    :param claim: the run that is being trained
    :param interval: seconds between two beats
    :param parent: the process that started this one; when it is gone, this one is to end. None for no such process
    """

    def __init__(self, ledger: Ledger, claim: Claim, interval: float = BEAT, parent: int | None = None):
        self._ledger, self._claim, self._interval, self._parent = ledger, claim, interval, parent
        self._start = time.monotonic()
        self._step = 0
        self._has_ended = threading.Event()
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> "Heart":
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._has_ended.set()
        self._thread.join()

    def watch(self, step: int) -> None:
        """
        Note how far the run is.

        :param step: environment steps
        :raises TrialLostError: if the run is not this process's any more
        """
        self._step = step
        if self._error is not None:
            raise self._error

    def _run(self) -> None:
        beat = 0
        while self._error is None:
            try:
                self._ledger.beat(self._claim, f"{os.getpid()}-{beat}", self._step, time.monotonic() - self._start)
            except Exception as error:
                self._error = error
            if self._parent is not None and os.getppid() != self._parent:
                os.kill(os.getpid(), signal.SIGTERM)
                return
            beat += 1
            if self._has_ended.wait(self._interval):
                break
        # The last word on what it took
        if self._error is None:
            try:
                self._ledger.beat(self._claim, f"{os.getpid()}-end", self._step, time.monotonic() - self._start)
            except Exception as error:
                self._error = error


def work(ledger: Ledger, logs: Path, name: str, beat: float = BEAT, parent: int | None = None, device: str = "auto") -> None:
    """
    Work a study off.

    :param ledger: the study
    :param logs: the folder of all sweeps' runs
    :param name: this process's name, for people
    :param beat: seconds between two heartbeats
    :param parent: the process that started this one
    :param device: where the networks compute
    :raises SystemExit: if the process is asked to end; its run is given back, to be taken up again
    """
    while True:
        ledger.recover()
        claim = ledger.claim(name)
        if claim is not None:
            _train_claimed(ledger, claim, logs, beat, parent, device)
        elif not ledger.left():
            return
        else:
            # Others' runs, or those of processes that have not been silent for long enough
            time.sleep(PAUSE)
            if parent is not None and os.getppid() != parent:
                raise SystemExit(TERMINATED)


def _train_claimed(ledger: Ledger, claim: Claim, logs: Path, beat: float, parent: int | None, device: str) -> None:
    folder = run_folder(logs, ledger.name, claim.run)
    folder.mkdir(parents=True, exist_ok=True)
    print(f"{time.strftime('%H:%M:%S')} {claim.run.key}", flush=True)

    def report(step: int, value: float) -> None:
        ledger.report(claim, step, value)

    try:
        # The lock: another process that was given up, but is not dead, may still be writing there
        with Heart(ledger, claim, beat, parent) as heart, FileLock(folder / ".lock"):
            final = train(claim.run, folder, report, heart.watch, device)
        ledger.complete(claim, final)
        forget_states(folder)
    except TrialLostError:
        print(f"{claim.run.key} was taken over by another process", flush=True)
    except (*STORAGE_ERRORS, OSError):
        # The database or the disk, and no fault of the run's
        ledger.release(claim)
        raise
    except Exception as error:
        traceback.print_exc()
        ledger.fail(claim, error)
    except BaseException:
        ledger.release(claim)
        raise


def terminate(number: int, frame: FrameType | None) -> None:
    """
    End as a process that was told to.

    :param number: the signal
    :param frame: where the process was
    :raises SystemExit: always
    """
    raise SystemExit(128 + number)


def _terminate(number: int, frame: FrameType | None) -> None:
    signal.raise_signal(signal.SIGTERM)


def parse(argv: Sequence[str]) -> argparse.Namespace:
    """
    Read the command line.

    :param argv: the arguments
    :return: what they say
    """
    parser = argparse.ArgumentParser(prog="python -m benchmark.worker", description="Work off a study's runs.")
    parser.add_argument("--study", required=True, help="the study's name")
    parser.add_argument("--storage", required=True, help="the URL of its storage")
    parser.add_argument("--logs", type=Path, required=True, help="the folder of all sweeps' runs")
    parser.add_argument("--threads", type=count, default=1, help="PyTorch's threads (default: %(default)s)")
    parser.add_argument("--device", default="auto", help="where the networks compute (default: %(default)s)")
    parser.add_argument("--beat", type=float, default=BEAT, help="seconds between two heartbeats (default: %(default)s)")
    parser.add_argument("--grace", type=float, default=GRACE, help="seconds until a silent process is given up")
    parser.add_argument("--parent", type=int, help="the process after which this one is to end, too")
    return parser.parse_args(argv)


def main(argv: Sequence[str] | None = None) -> None:
    """
    Work a study off.

    :param argv: the command line; None for the process's own
    """
    args = parse(sys.argv[1:] if argv is None else argv)
    signal.signal(signal.SIGTERM, terminate)
    # Ctrl-C in a terminal reaches all of its processes: this one's parent tells it to end. Without one it is to give its run
    # back: rl_zoo3 takes Ctrl-C for a training's end.
    signal.signal(signal.SIGINT, _terminate if args.parent is None else signal.SIG_IGN)
    th.set_num_threads(args.threads)
    arguments: dict[str, Any] = dict(beat=args.beat, parent=args.parent, device=args.device)
    ledger = Ledger(patiently(open_storage, args.storage), args.study, args.grace)
    work(ledger, args.logs, f"{socket.gethostname()}:{os.getpid()}", **arguments)


if __name__ == "__main__":
    main()
