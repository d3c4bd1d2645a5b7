"""
A process that works off a study: it claims a run, trains it, and claims the next, until all have ended.

``benchmark.sweep`` starts these; ``python -m benchmark.worker --help`` says how to start one by hand.
"""

import argparse
import functools
import os
import socket
import sys
import time
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch as th
from filelock import FileLock

from benchmark.common.arguments import count
from benchmark.sweeps.heartbeats import BEAT, Heart, TrialLostError
from benchmark.sweeps.processes import TERMINATED, add_heartbeats, listen, see_that_grace_is_longer
from benchmark.sweeps.run import MACHINE_ERRORS, forget_states, run_folder, train
from benchmark.sweeps.storages import open_storage, patiently
from benchmark.sweeps.studies import Claim, Ledger

# Seconds between two looks at a study of which no run waits
PAUSE = 2.0


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
        with Heart(functools.partial(ledger.beat, claim), beat, parent) as heart, FileLock(folder / ".lock"):
            final = train(claim.run, folder, report, heart.watch, device)
        ledger.complete(claim, final)
        forget_states(folder)
    except TrialLostError:
        print(f"{claim.run.key} was taken over by another process", flush=True)
    except MACHINE_ERRORS:
        ledger.release(claim)
        raise
    except Exception as error:
        traceback.print_exc()
        ledger.fail(claim, error)
    except BaseException:
        ledger.release(claim)
        raise


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
    add_heartbeats(parser)
    parser.add_argument("--parent", type=int, help="the process after which this one is to end, too")
    return parser.parse_args(argv)


def main(argv: Sequence[str] | None = None) -> None:
    """
    Work a study off.

    :param argv: the command line; None for the process's own
    """
    args = parse(sys.argv[1:] if argv is None else argv)
    see_that_grace_is_longer(args.beat, args.grace)
    listen(args.parent)
    th.set_num_threads(args.threads)
    arguments: dict[str, Any] = dict(beat=args.beat, parent=args.parent, device=args.device)
    ledger = Ledger(patiently(open_storage, args.storage), args.study, args.grace)
    work(ledger, args.logs, f"{socket.gethostname()}:{os.getpid()}", **arguments)


if __name__ == "__main__":
    main()
