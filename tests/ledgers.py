"""Ledgers of studies, as several processes have them, and their trials."""

import os

from studies import GRACE, make_sweep

from benchmark.sweeps.studies import Ledger
from benchmark.sweeps.study_trials import SHARED


def open_ledger(storage, clock, **sweep):
    ledger, made = Ledger(storage, "study", GRACE, clock), make_sweep(**({"methods": ["Good"], "seeds": 3} | sweep))
    ledger.open(made, {"experiment": "tiny", SHARED: made.shared})
    return ledger


def another(ledger, clock=None):
    """A ledger of another process."""
    return Ledger(ledger.storage, ledger.name, GRACE, clock or ledger._silence._clock)


def look_for(ledger, seconds):
    """Let a process look again and again, and the time pass."""
    for _ in range(round(seconds / 5)):
        ledger.recover()
        ledger._silence._clock.sleep(5)
    ledger.recover()


def trials_of(storage):
    return storage.get_all_trials(storage.get_study_id_from_name("study"))


def forked(act):
    child = os.fork()
    if child == 0:
        status = 1
        try:
            act()
            status = 0
        finally:
            os._exit(status)
    return child
