"""A study's runs as small text files, for figures and to be kept in a repository."""

from pathlib import Path

from benchmark.files import write_json
from benchmark.records import write_records
from benchmark.storages import open_storage
from benchmark.studies import Ledger

STUDY = "study.json"


def export_study(name: str, storage_url: str, results: Path) -> Path:
    """
    Write what is known of a study's ended runs, and what the study is.

    :param name: the study's name
    :param storage_url: where the study is
    :param results: the folder of all studies' results
    :return: the study's own folder, in it
    :raises KeyError: if there is no such study
    """
    ledger = Ledger(open_storage(storage_url), name)
    folder = results / name
    write_json(folder / STUDY, ledger.description())
    write_records(folder, ledger.records())
    return folder
