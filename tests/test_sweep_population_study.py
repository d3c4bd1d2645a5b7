"""Populations in a study: runs that fail, and the page of a sweep by populations."""

import json
import shutil
from dataclasses import fields

import numpy as np
import pytest
from optuna.storages import InMemoryStorage
from sweep_populations import NOISE, rows, study_of, write_sweep
from test_sweep_run import interrupt_at
from trainings import Interruption

from benchmark.common.records import Record
from benchmark.reporting.figures import figures
from benchmark.sweeps import population_run, worker_loop
from benchmark.sweeps.execution import describe
from benchmark.sweeps.experiments import load_sweep
from benchmark.sweeps.exports import export_study
from benchmark.sweeps.storages import open_storage
from benchmark.sweeps.studies import Ledger
from benchmark.sweeps.worker_loop import execute_runs

pytestmark = pytest.mark.usefixtures("short_final_evaluation", "short_episodes")


@pytest.mark.filterwarnings("ignore:Agent 1 has failed")
def test_a_run_that_diverges_fails_alone(tmp_path):
    path = write_sweep(
        tmp_path, {"A": ("td3", {}), "B": ("td3", dict(learning_rate=1e30)), "C": ("td3", dict(tau=0.1))}, seeds=1
    )
    records = {record.method: record for record in study_of(path, 8, tmp_path / "logs").records()}
    assert {record.population for record in records.values()} == {3}
    assert "loss was NaN or infinite at gradient step" in records["B"].error
    assert records["B"].error.startswith("ValueError: ")
    assert records["B"].final is None
    for name in ("A", "C"):
        assert (records[name].error, records[name].timesteps) == (None, [40, 80, 120])
        assert np.isfinite(records[name].final)


@pytest.mark.filterwarnings("ignore:Agent . has failed")
def test_runs_that_all_diverge_all_fail(tmp_path):
    path = write_sweep(tmp_path, {"B": ("td3", dict(learning_rate=1e30))})
    ledger = study_of(path, 8, tmp_path / "logs")
    assert ["loss was NaN or infinite at gradient step" in record.error for record in ledger.records()] == [True, True]
    # None was tried again
    assert len(ledger.trials()) == 2


def headings(page):
    return [line for line in page.read_text().splitlines() if line.startswith("#")]


def test_a_sweep_by_populations_has_the_runs_and_the_page_of_one_without(tmp_path):
    path = write_sweep(
        tmp_path, {"T": ("td3", NOISE), "S": ("sac", {})}, axes={"learning_rate": {"values": [0.001, 0.01]}}, steps=80
    )
    sweep, found = load_sweep(str(path)), {}
    for size in (1, 8):
        folder, url = tmp_path / str(size), f"sqlite:///{tmp_path}/{size}.db"
        ledger = Ledger(open_storage(url), "tiny")
        ledger.open(sweep, describe(sweep, ["tiny"], "cpu"))
        execute_runs(ledger, folder / "logs", "a process", device="cpu", population=size)
        exported = export_study("tiny", url, folder / "results")
        page = figures([exported], folder / "results", repetitions=100)
        found[size] = ledger.records(), headings(page), [*map(json.loads, (exported / "runs.jsonl").read_text().splitlines())]
    (alone, headings_alone, lines_alone), (together, headings_together, lines_together) = found[1], found[8]
    assert headings_together == headings_alone
    assert {record.key for record in together} == {record.key for record in alone} == {run.key for run in sweep.runs()}
    assert [[*line] for line in lines_together] == [[*line] for line in lines_alone]
    assert [*lines_alone[0]] == [field.name for field in fields(Record)]
    same = ("experiment", "method", "task", "settings", "seed", "steps", "timesteps", "error")
    for one, other in zip(*(sorted(records, key=lambda record: record.key) for records in (alone, together)), strict=True):
        assert [getattr(one, name) for name in same] == [getattr(other, name) for name in same]
        # SAC's are trained alone, and the same
        assert (one.population, other.population) == ((1, 1) if one.method == "S" else (1, 4))
        assert (one.final == other.final) == (one.method == "S")
        assert other.processor_seconds > 0
    paths = [sorted(run.name for run in (tmp_path / size / "logs").glob("tiny/*/*/*")) for size in ("1", "8")]
    assert paths[0] == paths[1]
    assert not list((tmp_path / "8" / "logs" / "tiny" / "populations").iterdir())


@pytest.mark.filterwarnings("ignore:Agent 1 has failed")
@pytest.mark.parametrize("is_removed", [False, True])
def test_the_folder_of_a_run_that_has_failed_remains_as_it_is(tmp_path, monkeypatch, is_removed):
    path = write_sweep(tmp_path, {"A": ("td3", {}), "B": ("td3", dict(learning_rate=1e30))}, seeds=1, steps=60)
    sweep, ledger = load_sweep(str(path)), Ledger(InMemoryStorage(), "tiny")
    ledger.open(sweep, {"experiment": sweep.name})
    report = population_run.PopulationReporter._on_step
    with monkeypatch.context() as patch:
        # The first episode has ended
        stopping = lambda self: report(self) and (self.n_calls < 35 or interrupt_at(0)(0))  # noqa: E731
        patch.setattr(population_run.PopulationReporter, "_on_step", stopping)
        patch.setattr(worker_loop, "MACHINE_ERRORS", Interruption)
        with pytest.raises(Interruption):
            execute_runs(ledger, tmp_path / "logs", "a process", device="cpu", population=8)
    good, failed = ((next((tmp_path / "logs").glob(f"tiny/{name}/td3/*"))) for name in "AB")
    before = (failed / "0.monitor.csv").read_text()
    assert (len(rows(good)), len(rows(failed))) == (2, 1)
    if is_removed:
        shutil.rmtree(failed)
    execute_runs(ledger, tmp_path / "logs", "another process", device="cpu", population=8)
    assert len(rows(good)) == 3
    if not is_removed:
        assert (failed / "0.monitor.csv").read_text() == before
    records = {record.method: record for record in ledger.records()}
    assert records["A"].error is None
    assert records["A"].population == 2
