"""The work of one process: it claims a run of a study, trains it, and claims the next, until all have ended."""

import functools
import os
import time
import traceback
from pathlib import Path

from filelock import FileLock

from benchmark.sweeps.heartbeats import BEAT, HeartbeatThread, TrialLostError
from benchmark.sweeps.processes import PAUSE, TERMINATED
from benchmark.sweeps.run import MACHINE_ERRORS, forget_states, run_folder, train
from benchmark.sweeps.studies import Ledger
from benchmark.sweeps.study_trials import Claim


def execute_runs(
    ledger: Ledger, logs: Path, name: str, beat: float = BEAT, parent: int | None = None, device: str = "auto"
) -> None:
    """
    Execute the runs of a study until all have ended.

    :param ledger: the study
    :param logs: the folder of all sweeps' runs
    :param name: this process's name, for people
    :param beat: seconds between two heartbeats
    :param parent: the process that started this one
    :param device: device of the networks
    :raises SystemExit: if the process has to end; its run is given back, and any process continues it
    """
    while True:
        ledger.recover()
        claim = ledger.claim(name)
        if claim is not None:
            _train_claimed(ledger, claim, logs, beat, parent, device)
        elif not ledger.left():
            return
        else:
            # Runs of other processes, or of lost ones whose grace period has not passed
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
        # A process that was taken for lost may still write to the folder
        with HeartbeatThread(functools.partial(ledger.beat, claim), beat, parent) as heartbeat, FileLock(folder / ".lock"):
            final = train(claim.run, folder, report, heartbeat.watch, device)
        ledger.complete(claim, final)
        forget_states(folder)
    except TrialLostError:
        print(f"{claim.run.key} was given to another process", flush=True)
    except MACHINE_ERRORS:
        ledger.release(claim)
        raise
    except Exception as error:
        traceback.print_exc()
        ledger.fail(claim, error)
    except BaseException:
        ledger.release(claim)
        raise
