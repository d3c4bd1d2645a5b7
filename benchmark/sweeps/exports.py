"""A study's runs as small text files, for figures and to be kept in a repository."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from optuna.trial import TrialState

from benchmark.common.files import write_json
from benchmark.common.records import RUNS, STUDY, Record, read_records, write_records
from benchmark.sweeps.storages import open_storage
from benchmark.sweeps.studies import Ledger, owned
from benchmark.sweeps.sweep_files import SweepError

# Options that say where files and databases are, and may hold a password
PRIVATE = ("--storage", "--logs", "--results")


def without_places(argv: Sequence[str]) -> list[str]:
    """
    Leave out of a command line what is of no influence on results, and no one else's business.

    :param argv: the arguments
    :return: those without the places of files and databases
    """
    kept: list[str] = []
    for argument in argv:
        if kept and kept[-1] in PRIVATE:
            kept.pop()
        elif not argument.startswith(tuple(f"{option}=" for option in PRIVATE)):
            kept.append(argument)
    return kept


def export_study(name: str, storage_url: str, results: Path) -> Path:
    """
    Write what is known of a study's ended runs, and what the study is.

    :param name: the study's name
    :param storage_url: where the study is
    :param results: the folder of all studies' results
    :return: the study's own folder, in it
    :raises KeyError: if there is no such study
    :raises SweepError: if the folder has runs that the study lacks, which would be lost
    """
    ledger = Ledger(open_storage(storage_url), name)
    folder = results / name
    see_that_none_is_lost(folder, ledger)
    write_json(folder / STUDY, ledger.description())
    write_records(folder, ledger.records())
    return folder


def see_that_none_is_lost(folder: Path, ledger: Ledger) -> None:
    """
    See that a study has all runs that its folder of results has, before these are written anew.

    :param folder: the study's folder of results
    :param ledger: the study
    :raises SweepError: if it lacks some
    """
    exported = {record.key for record in read_records(folder)} if (folder / RUNS).is_file() else set()
    lacking = exported - {key for key, trial in owned(ledger.trials()).items() if trial.state is not TrialState.WAITING}
    if lacking:
        problem = f"has {len(lacking)} ended runs that the study lacks, such as {min(lacking)}"
        remedy = "Take them by --adopt, with the methods and seeds that they are of, or choose another folder by --results"
        raise SweepError(folder / RUNS, "", f"{problem}. {remedy}")


def ended_runs(folder: Path, description: dict[str, Any]) -> tuple[list[Record], list[dict[str, Any]]]:
    """
    Read what was exported of a study's runs, to go on with it where its storage is not at hand.

    :param folder: the study's folder of results
    :param description: what the sweep is
    :return: the runs, and the commands that trained them
    :raises SweepError: if they were trained with other settings, naming one
    """
    if not (folder / STUDY).is_file():
        return [], []
    was = json.loads((folder / STUDY).read_text())
    for key in ("steps", "evaluation_interval", "evaluation_episodes", "configurations"):
        now = description[key]
        if key == "configurations":
            both = was[key].keys() & now.keys()
            same = all(was[key][name] == now[name] for name in both)
        else:
            same = was[key] == now
        if not same:
            raise SweepError(folder / STUDY, key, "differs from the sweep's, so that its runs cannot be adopted")
    return read_records(folder), was["commands"]
