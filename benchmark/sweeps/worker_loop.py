"""The work of one process: it claims runs of a study, trains them, and claims the next, until all have ended."""

import os
import shutil
import time
import traceback
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from stable_baselines3.common.utils import get_device

from benchmark.common.provenance import machine, processor
from benchmark.sweeps.attempts import outcome_of
from benchmark.sweeps.claimed_runs import ClaimedRuns
from benchmark.sweeps.groups import FOLDER, GROUP_RUNS, Group, Groups
from benchmark.sweeps.heartbeats import BEAT, HeartbeatThread, TrialLostError
from benchmark.sweeps.locks import locked
from benchmark.sweeps.population_run import train_group
from benchmark.sweeps.processes import PAUSE
from benchmark.sweeps.run import MACHINE_ERRORS, forget_states, has_state, run_folder, train
from benchmark.sweeps.runs import Run
from benchmark.sweeps.signals import TERMINATED, end_if_asked, undisturbed
from benchmark.sweeps.studies import Ledger
from benchmark.sweeps.study_trials import PROCESSORS, Claim, owned, run_of
from benchmark.sweeps.validation import SweepError
from sb3_cgp.resumption.store import StateStore


def execute_runs(
    ledger: Ledger,
    logs: Path,
    name: str,
    beat: float = BEAT,
    parent: int | None = None,
    device: str = "auto",
    population: int = 1,
) -> None:
    """
    Execute the runs of a study until all have ended.

    :param ledger: the study
    :param logs: the folder of all sweeps' runs
    :param name: this process's name, for people
    :param beat: seconds between two heartbeats
    :param parent: the process that started this one
    :param device: device of the networks
    :param population: the largest number of runs that are trained together
    :raises SystemExit: if the process has to end; its runs are given back, and any process continues them
    """
    groups = Groups(logs, ledger.name, population)
    while True:
        end_if_asked()
        ledger.recover()
        claims: list[Claim] = []
        try:
            with undisturbed():
                claims, group = groups.claim(ledger, name)
            end_if_asked()
            if claims:
                _train_claimed(ledger, claims, group, logs, beat, parent, device)
                continue
        except (SystemExit, KeyboardInterrupt):
            # What has ended, or was given back, stays as it is
            with undisturbed():
                for claim in claims:
                    ledger.release(claim)
            raise
        if not ledger.left():
            forget_ended(ledger, logs)
            return
        # Runs of other processes, or of lost ones whose grace period has not passed
        time.sleep(PAUSE)
        if parent is not None and os.getppid() != parent:
            raise SystemExit(TERMINATED)


def _train_claimed(
    ledger: Ledger, claims: Sequence[Claim], group: Group | None, logs: Path, beat: float, parent: int | None, device: str
) -> None:
    runs = [claims[0].run] if group is None else group.runs
    folders = [run_folder(logs, ledger.name, run) for run in runs]
    claimed = ClaimedRuns(ledger, claims, len(runs))
    print(f"{time.strftime('%H:%M:%S')} {_in_words(claims, group)}", flush=True)

    def report(step: int, value: float) -> None:
        claimed.report(runs[0], step, value)

    # The states are removed before the locks are released, as another process may then continue from them
    with ExitStack() as locks:
        try:
            claimed.annotate(PROCESSORS, [processor(machine(get_device(device)))])
            with HeartbeatThread(claimed.beat, beat, parent) as heartbeat:
                locks.enter_context(locked(folders))
                if has_state(runs[0], folders[0]) if group is None else StateStore(group.states).steps():
                    claimed.note_continuation()
                if group is None:
                    finals = {0: train(runs[0], folders[0], report, heartbeat.watch, device)}
                else:
                    finals = train_group(group, folders, claimed, heartbeat.watch, device)
            lost = [runs[index].key for index, final in finals.items() if not claimed.complete(runs[index], final)]
            for key in lost:
                print(f"{key} was given to another process", flush=True)
            # Another process continues a lost run from its last state
            if not lost:
                _forget(group, folders)
        except TrialLostError:
            print(f"{_in_words(claims, group)} was given to another process", flush=True)
            with undisturbed():
                claimed.release()
        except MACHINE_ERRORS as error:
            with undisturbed():
                if claimed.is_stuck(error):
                    _give_up(claimed, runs, group, folders, error)
                else:
                    claimed.release(outcome_of(error))
            raise
        except Exception as error:
            traceback.print_exc()
            with undisturbed():
                _give_up(claimed, runs, group, folders, error)


def _give_up(
    claimed: ClaimedRuns, runs: Sequence[Run], group: Group | None, folders: Sequence[Path], error: Exception
) -> None:
    """End a run by an error, or dissolve a population, of which some run is to blame."""
    if group is None:
        claimed.fail(runs[0], error)
    else:
        if claimed.is_held():
            _forget(group, folders)
        claimed.dissolve(error)


def _in_words(claims: Sequence[Claim], group: Group | None) -> str:
    keys = ", ".join(claim.run.key for claim in claims)
    return keys if group is None else f"population {group.folder.name} of {len(group.runs)}: {keys}"


def forget_ended(ledger: Ledger, logs: Path) -> None:
    """
    Remove the states of ended runs, which are left where a process was killed between the end of a run and their removal.

    :param ledger: a study of which no run is left
    :param logs: the folder of all sweeps' runs
    """
    ended = [run_of(trial) for trial in owned(ledger.trials()).values() if trial.state.is_finished()]
    for path in (logs / ledger.name / FOLDER).glob(f"*/{GROUP_RUNS}"):
        try:
            group = Group.read(path.parent)
        except SweepError:
            # Of another version's study of this name
            continue
        if all(run in ended for run in group.runs):
            _forget(group, [])
    for run in ended:
        folder = run_folder(logs, ledger.name, run)
        if has_state(run, folder):
            forget_states(folder)


def _forget(group: Group | None, folders: Sequence[Path]) -> None:
    """Remove the states of runs that have ended."""
    if group is None:
        forget_states(folders[0])
    else:
        shutil.rmtree(group.folder, ignore_errors=True)
