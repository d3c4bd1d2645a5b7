"""The runs of a study as small text files, for figures and for a repository."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from optuna.trial import TrialState

from benchmark.common.files import write_json
from benchmark.common.provenance import processors_of_commands
from benchmark.common.records import (
    REWRITE,
    RUNS,
    STUDY,
    Record,
    entries_by_task,
    read_description,
    read_records,
    write_records,
)
from benchmark.sweeps.experiments import difference
from benchmark.sweeps.storages import open_storage
from benchmark.sweeps.study_trials import SHARED, owned
from benchmark.sweeps.study_view import StudyView
from benchmark.sweeps.validation import SweepError

# Options with the paths of files and the URLs of databases, which may hold a password
PRIVATE = ("--storage", "--logs", "--results")


def without_places(argv: Sequence[str]) -> list[str]:
    """
    Return a command line without the options that have no influence on results, and may be private.

    :param argv: the arguments
    :return: the arguments without the paths of files and the URLs of databases
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
    Write the records of a study's ended runs, and the study's description.

    :param name: the study's name
    :param storage_url: the URL of its storage
    :param results: the folder of all studies' results
    :return: the study's own folder, in it
    :raises KeyError: if there is no such study
    :raises ValueError: if there is no such storage
    :raises SweepError: if the folder holds runs that the study lacks, which would be lost
    """
    study = StudyView(open_storage(storage_url, create=False), name)
    folder = results / name
    check_no_run_is_lost(folder, study)
    write_json(folder / STUDY, study.description())
    write_records(folder, study.records())
    return folder


def check_no_run_is_lost(folder: Path, study: StudyView) -> None:
    """
    Check that a study has all runs that its folder of results holds, before these are written anew.

    :param folder: the study's folder of results
    :param study: the study
    :raises SweepError: if it lacks some
    :raises ValueError: if the file of the runs is damaged; it names the file, the line and the remedy
    """
    exported = {record.key for record in read_records(folder)} if (folder / RUNS).is_file() else set()
    lacking = exported - {key for key, trial in owned(study.trials()).items() if trial.state is not TrialState.WAITING}
    if lacking:
        problem = f"has {len(lacking)} ended runs that the study lacks, such as {min(lacking)}"
        remedy = "Take them by --adopt, with the methods and seeds that they are of, or choose another folder by --results"
        raise SweepError(folder / RUNS, "", f"{problem}. {remedy}")


def ended_runs(folder: Path, description: dict[str, Any]) -> tuple[list[Record], list[dict[str, Any]]]:
    """
    Read the exported runs of a study, to continue it with another storage.

    :param folder: the study's folder of results
    :param description: the sweep's description
    :return: the runs, and the commands that trained them
    :raises SweepError: if they were trained with other settings; it names one
    :raises ValueError: if a file is damaged; it names the file and the remedy
    """
    if not (folder / RUNS).is_file():
        return [], []
    if not (folder / STUDY).is_file():
        raise SweepError(folder / STUDY, "", f"is missing, so that the runs beside it cannot be adopted; {REWRITE}")
    was = read_description(folder, "configurations")
    for key in ("steps", "evaluation_interval", "evaluation_episodes", "configurations"):
        if key == "configurations":
            before, now = entries_by_task(was), entries_by_task(description)
            same = all(before[each] == now[each] for each in before.keys() & now.keys())
        else:
            same = was[key] == description[key]
        if not same:
            raise SweepError(folder / STUDY, key, "differs from the sweep's, so that its runs cannot be adopted")
    if found := difference(was.get(SHARED), description[SHARED]):
        raise SweepError(folder / STUDY, found[0], f"{found[1]}, so that its runs cannot be adopted")
    used = processors_of_commands(was["commands"])
    # Earlier versions recorded the machines of the commands only
    known = used if len(used) == 1 else []
    records = read_records(folder, was["steps"])
    return [replace(record, processors=record.processors or known) for record in records], was["commands"]
