"""Exported runs that another study adopts, and what a study says of all that it was given."""

import json
from contextlib import nullcontext
from dataclasses import replace

import pytest
import torch as th
from optuna.trial import TrialState
from sweep_commands import SMALL, of_command_line

from benchmark.common.provenance import machine, processor
from benchmark.common.records import STUDY, read_records, write_records
from benchmark.sweep import main
from benchmark.sweeps.execution import describe
from benchmark.sweeps.exports import ended_runs, export_study
from benchmark.sweeps.storages import open_storage
from benchmark.sweeps.studies import Ledger
from benchmark.sweeps.study_trials import KEY
from benchmark.sweeps.validation import SweepError

pytestmark = pytest.mark.usefixtures("in_tmp_path")


@pytest.fixture
def ledger(tmp_path):
    """A study that is enqueued, of two runs."""
    sweep, _ = of_command_line(*SMALL, "--results", str(tmp_path / "results"))
    ledger = Ledger(open_storage(f"sqlite:///{tmp_path}/studies.db"), "mine")
    ledger.open(sweep, describe(sweep, SMALL, "cpu"))
    return ledger


def end_both(ledger):
    """End the study's runs, one by an error, and list the records."""
    first = ledger.claim("w")
    ledger.beat(first, "1", 400, 12.0)
    for step, value in ((20, -5.0), (40, -4.0)):
        ledger.report(first, step, value)
    ledger.complete(first, -3.0)
    ledger.fail(ledger.claim("w"), ValueError("a NaN"))
    return ledger.records()


def test_an_exported_study_is_adopted_by_another(tmp_path, ledger):
    end_both(ledger)
    folder = export_study("mine", f"sqlite:///{tmp_path}/studies.db", tmp_path / "results")
    here = processor(machine(th.device("cpu")))
    # Exported by an earlier version, which recorded the machines of the commands only
    assert all(record.processors == [] for record in read_records(folder))
    records = [replace(record, processors=[here]) for record in read_records(folder)]
    assert {record.error for record in records} == {None, "ValueError: a NaN"}
    (done,) = (record for record in records if record.error is None)
    assert (done.timesteps, done.returns, done.final, done.seconds) == ([20, 40], [-5.0, -4.0], -3.0, 12.0)

    sweep, _ = of_command_line(*SMALL[:-4], "--seeds", "2", "--methods", "TD3", "--results", str(tmp_path / "results"))
    description = describe(sweep, ["mine"], "cpu")
    ended, commands = ended_runs(folder, description)
    other = Ledger(open_storage(f"sqlite:///{tmp_path}/other.db"), "mine")
    other.open(sweep, description | {"commands": [*commands, *description["commands"]]}, ended)
    told = [(command["command"], command["runs_ended"]) for command in other.description()["commands"]]
    assert told == [(f"python -m benchmark.sweep {' '.join(SMALL)}", 0), ("python -m benchmark.sweep mine", 2)]
    assert sorted(map(str, other.records())) == sorted(map(str, records))
    waiting = [trial.user_attrs[KEY] for trial in other.trials() if trial.state is TrialState.WAITING]
    assert len(waiting) == 2
    assert all(key.endswith("seed=1") for key in waiting)
    # Once
    other.open(sweep, description, ended)
    assert len(other.trials()) == 4
    # Whatever trained them, of two machines
    facts = json.loads((folder / STUDY).read_text())
    elsewhere = {"machine": {"gpu": "H100"}, "command": "python -m benchmark.sweep mine", "runs_ended": 1}
    (folder / STUDY).write_text(json.dumps(facts | {"commands": [*facts["commands"], elsewhere]}))
    assert all(record.processors == [] for record in ended_runs(folder, description)[0])
    write_records(folder, [replace(record, processors=["H100"]) for record in records])
    assert all(record.processors == ["H100"] for record in ended_runs(folder, description)[0])


def test_a_study_that_is_adopted_whole_still_says_what_trained_it(tmp_path, ledger):
    end_both(ledger)
    folder = export_study("mine", f"sqlite:///{tmp_path}/studies.db", tmp_path / "results")
    before = (folder / "study.json").read_text()
    again = ["--study", "mine", "--adopt", "--storage", f"sqlite:///{tmp_path}/other.db", "--logs", str(tmp_path / "logs")]
    main([*SMALL, *again, "--results", str(tmp_path / "results")])
    assert (folder / "study.json").read_text() == before


def test_runs_that_wait_are_adopted_and_those_that_have_begun_are_not(tmp_path, ledger):
    records = end_both(ledger)
    sweep, _ = of_command_line(*SMALL, "--results", str(tmp_path))
    other = Ledger(open_storage(f"sqlite:///{tmp_path}/other.db"), "mine")
    other.open(sweep, describe(sweep, [], "cpu"))
    begun = other.claim("w")
    other.open(sweep, describe(sweep, [], "cpu"), records)
    assert [record.key for record in other.records()] == [record.key for record in records if record.key != begun.run.key]
    assert other.left() == [begun.run.key]
    other.complete(begun, -1.0)
    assert {record.key: record.final for record in other.records()} == {
        record.key: -1.0 if record.key == begun.run.key else record.final for record in records
    }
    assert other.claim("w") is None


@pytest.mark.parametrize("options", [[], ["--adopt", "--methods", "SAC"]])
def test_exported_runs_are_not_overwritten_by_fewer(tmp_path, ledger, monkeypatch, options):
    """... where the storage is gone, or the command is of other runs."""
    end_both(ledger)
    folder = export_study("mine", f"sqlite:///{tmp_path}/studies.db", tmp_path / "results")
    before = (folder / "runs.jsonl").read_bytes()
    monkeypatch.setattr("benchmark.sweeps.execution.start_workers", lambda *args: pytest.fail("it trains"))
    places = ["--results", str(tmp_path / "results"), "--storage", f"sqlite:///{tmp_path}/new.db", "--study", "mine"]
    with pytest.raises(SystemExit, match="has 2 ended runs that the study lacks, such as TD3,train_every=episode"):
        main([*SMALL, *places, *options])
    with pytest.raises(SweepError, match="has 2 ended runs that the study lacks"):
        export_study("mine", f"sqlite:///{tmp_path}/new.db", tmp_path / "results")
    assert (folder / "runs.jsonl").read_bytes() == before


def finished(tmp_path, ledger, monkeypatch):
    """The command line of a sweep that has ended, and the folder of its results."""
    end_both(ledger)
    storage = f"sqlite:///{tmp_path}/studies.db"
    monkeypatch.setattr("benchmark.sweeps.execution.forget_ended", lambda *args: None)
    folder = export_study("mine", storage, tmp_path / "results")
    return [*SMALL, "--study", "mine", "--storage", storage, "--results", str(tmp_path / "results")], folder


def test_damaged_runs_are_named_and_written_again_once_moved_away(tmp_path, ledger, monkeypatch):
    command, folder = finished(tmp_path, ledger, monkeypatch)
    monkeypatch.setattr("benchmark.sweep.figures", lambda *args: "page")
    runs, whole = folder / "runs.jsonl", (folder / "runs.jsonl").read_bytes()
    runs.write_bytes(whole[:-30])
    with pytest.raises(SystemExit, match=rf"^Error: {runs}, line 2, is no JSON: .*Move it away, and give the command"):
        main(command)
    runs.rename(folder / "damaged")
    main(command)
    assert runs.read_bytes() == whole
    (folder / STUDY).write_text("{}")
    with pytest.raises(SystemExit, match=rf"^Error: {folder / STUDY} lacks title, .*configurations\. Move it away"):
        main([*command, "--adopt"])


def test_another_studys_incomplete_folder_ends_a_finished_sweep_with_its_name(tmp_path, ledger, monkeypatch):
    command, folder = finished(tmp_path, ledger, monkeypatch)
    other = folder.parent / "other"
    other.mkdir()
    (other / "runs.jsonl").touch()
    with pytest.raises(SystemExit, match=rf"^Error: {other} is no folder of a study: study.json is missing; give"):
        main(command)


@pytest.mark.parametrize(("missing", "is_refused"), [("study.json", True), ("runs.jsonl", False)])
def test_half_of_a_studys_folder_is_not_adopted(tmp_path, ledger, monkeypatch, missing, is_refused):
    """The description is written before the runs, so that it may be alone."""
    _, folder = finished(tmp_path, ledger, monkeypatch)
    (folder / missing).unlink()
    description = describe(of_command_line(*SMALL, "--results", str(tmp_path))[0], [], "cpu")
    if not is_refused:
        assert ended_runs(folder, description) == ([], [])
        return
    with pytest.raises(
        SweepError, match=rf"{folder / missing}: is missing, so that the runs beside it cannot be adopted; give"
    ):
        ended_runs(folder, description)


def test_runs_of_earlier_commands_are_told(tmp_path, ledger, monkeypatch, capsys):
    started = []
    monkeypatch.setattr("benchmark.sweeps.execution.start_workers", lambda *args: started.append(args) or [])
    places = ["--results", str(tmp_path / "results"), "--storage", f"sqlite:///{tmp_path}/studies.db", "--study", "mine"]
    for options, is_told in ([], False), (["--methods", "SAC"], True):
        with pytest.raises(SystemExit, match="runs of mine are left"):
            main([*SMALL, *places, *options])
        told = "mine also has 2 runs of earlier commands to train, such as TD3,"
        assert (told in capsys.readouterr().err) == is_told
    assert len(started) == 2


def test_a_study_says_all_that_it_was_ever_given(tmp_path, ledger):
    more, _ = of_command_line(*SMALL[:-2], "--methods", "SAC", "CGP-Online", "--results", str(tmp_path))
    ledger.open(more, describe(more, ["more"], "cpu"))
    # Again, and of a study that has nothing left to train
    ledger.open(more, describe(more, ["more"], "cpu"))
    while (claim := ledger.claim("w")) is not None:
        ledger.complete(claim, 1.0)
    ledger.open(more, describe(more, ["idle"], "cpu"))
    told = ledger.description()
    assert (told["methods"], told["seeds"], told["runs_planned"]) == (["CGP-Online", "TD3", "SAC"], [0], 6)
    assert len(told["configurations"]) == 6
    assert [command["command"].split()[-1] for command in told["commands"]] == ["TD3", "more"]
    shorter, _ = of_command_line(*SMALL[:-2], "--methods", "DDPG", "--steps", "300", "--results", str(tmp_path))
    with pytest.raises(SweepError, match=r"steps: was 400 and is now 300.*--study"):
        ledger.open(shorter, describe(shorter, [], "cpu"))


@pytest.mark.parametrize("options", [["--seeds", "2"], ["--methods", "SAC"], []])
def test_a_repeated_command_leaves_the_settings_of_a_study(tmp_path, ledger, options):
    before = ledger.description()["settings_in_words"]
    again, _ = of_command_line(*SMALL, *options, "--results", str(tmp_path))
    ledger.open(again, describe(again, ["again"], "cpu"))
    assert ledger.description()["settings_in_words"] == before
    assert not any(word in before for word in ("tasks", "seeds", "methods"))


def test_runs_of_other_settings_are_not_adopted(tmp_path, ledger):
    folder = export_study("mine", f"sqlite:///{tmp_path}/studies.db", tmp_path / "results")
    for option, key in ((["--steps", "401"], "steps"), (["--set", "gamma=0.5"], "configurations")):
        sweep, _ = of_command_line(*SMALL, *option, "--eval-interval", "20", "--results", str(tmp_path))
        with pytest.raises(SweepError, match=key):
            ended_runs(folder, describe(sweep, [], "cpu"))
    other, _ = of_command_line(*SMALL[:-2], "--methods", "SAC", "--set", "gamma=0.5", "--results", str(tmp_path))
    with pytest.raises(SweepError, match=r"hyperparams\.gamma: was 'not given' and is now 0\.5, .* cannot be adopted"):
        ended_runs(folder, describe(other, [], "cpu"))
    assert ended_runs(tmp_path / "nothing", {}) == ([], [])


def test_runs_are_adopted_by_task_where_the_tasks_entries_differ(tmp_path):
    """The names of configurations have the task where its entry is not the others'."""
    (tmp_path / "runs.jsonl").touch()
    entries = {"TD3": {"algo": "td3", "gamma": 0.98}}
    was = {
        "steps": 10,
        "evaluation_interval": 5,
        "evaluation_episodes": 1,
        "tasks": ["Pendulum-v1"],
        "configurations": entries,
    }
    facts = {
        "title": "",
        "experiment": "e",
        "axes": {},
        "settings_in_words": "",
        "methods": ["TD3"],
        "seeds": [0],
        "runs_planned": 1,
        "commands": [],
    }
    (tmp_path / "study.json").write_text(json.dumps(facts | was))
    for gamma, is_refused in ((0.98, False), (0.5, True)):
        now = {"TD3,Pendulum-v1": {"algo": "td3", "gamma": gamma}, "TD3,Reacher-v5": {"algo": "td3", "gamma": 0.9}}
        description = was | {"tasks": ["Pendulum-v1", "Reacher-v5"], "configurations": now, "shared": {}}
        with pytest.raises(SweepError, match="configurations") if is_refused else nullcontext():
            ended_runs(tmp_path, description)
