"""The command that runs sweeps: its arguments, and what it exports and adopts."""

import json
from contextlib import nullcontext
from dataclasses import replace

import pytest
import torch as th
import yaml
from optuna.trial import TrialState

from benchmark import tune, worker
from benchmark.common.arguments import hyperparameter
from benchmark.common.provenance import machine, processor
from benchmark.common.records import STUDY, Record, read_records, write_records
from benchmark.sweep import load, main, parse
from benchmark.sweeps.checks import check_values
from benchmark.sweeps.execution import describe
from benchmark.sweeps.experiments import load_sweep, study_name
from benchmark.sweeps.exports import ended_runs, export_study
from benchmark.sweeps.storages import open_storage
from benchmark.sweeps.studies import Ledger
from benchmark.sweeps.study_trials import KEY
from benchmark.sweeps.validation import SweepError

SMALL = ["e8", "--task", "Pendulum-v1", "--steps", "400", "--seeds", "1", "--methods", "TD3"]


def of_command_line(*argv):
    args = parse(argv)
    return load(args.name, args), args


def test_options_replace_what_the_file_says(tmp_path):
    sweep, args = of_command_line(
        *SMALL, "--set", "gamma=0.9", "policy_kwargs=dict(net_arch=[8, 8])", "learning_rate=1e-2", "--results", str(tmp_path)
    )
    runs = sweep.runs()
    assert len(runs) == 2
    assert {(run.method, run.task, run.steps, run.evaluation_interval, run.seed) for run in runs} == {
        ("TD3", "Pendulum-v1", 400, 20, 0)
    }
    for run in runs:
        assert (run.hyperparams["gamma"], run.hyperparams["learning_rate"]) == (0.9, 0.01)
        assert run.hyperparams["policy_kwargs"] == "dict(net_arch=[8, 8])"
    assert study_name(sweep.name, args.study, args.task) == "e8-Pendulum-v1"


def test_hyperparameters_and_packages_may_be_given_one_by_one(tmp_path):
    several = "--set gamma=0.9 tau=0.02 --set tau=0.01 --gym-packages one --gym-packages two"
    args = parse(["e3", *several.split(), "--results", str(tmp_path)])
    assert (dict(args.set), args.gym_packages) == ({"gamma": 0.9, "tau": 0.01}, ["one", "two"])
    assert parse(["e3", "--results", str(tmp_path)]).set == []


@pytest.mark.parametrize("parse", [parse, worker.parse, tune.parse])
def test_a_device_that_is_not_there_is_refused_before_it_can_fail_runs(tmp_path, capsys, parse):
    needed = {
        worker.parse: ["--study", "e3", "--storage", "sqlite:///a.db", "--logs", str(tmp_path)],
        tune.parse: ["--algo", "td3", "--env", "Pendulum-v1"],
    }
    for device in ("cdua", "cuda:7"):
        with pytest.raises(SystemExit):
            parse([*needed.get(parse, ["e3", "--results", str(tmp_path)]), "--device", device])
        assert f"argument --device: '{device}' is not available" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "value"), [("a=1", 1), ("a=1e-3", 0.001), ("a=[1, x]", [1, "x"]), ("a=null", None), ("a=step", "step")]
)
def test_a_hyperparameter_is_read_as_yaml_files_are(text, value):
    assert hyperparameter(text) == ("a", value)


def write_sweep(folder, **changes):
    """A sweep of a method of one's own."""
    content = dict(title="A sweep", tasks=["Pendulum-v1"], steps=100, seeds=1, evaluation_interval=50) | changes
    path = folder / "mine.yml"
    path.write_text(yaml.safe_dump(content))
    return str(path)


def method(algo, **hyperparams):
    return {"M": {"algo": algo, "hyperparams": {"policy": "MlpPolicy"} | hyperparams}}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (dict(methods=method("cgp", tau=3)), ["M on Pendulum-v1", "`tau`"]),
        # Each value is right, but not all combinations are
        (
            dict(
                methods=method("cgp"),
                axes={"cem_samples": {"values": [8, 64]}, "cem_elites": {"values": [6, 20]}},
            ),
            ["M,cem_elites=20,cem_samples=8 on Pendulum-v1", "`cem_elites`"],
        ),
        (dict(methods=method("td3", policy="MlpPolcy")), ["M on Pendulum-v1", "MlpPolcy"]),
        (dict(methods=method("td3", policy_kwargs="dict(net_arch=[8, '8'])")), ["M on Pendulum-v1", "TypeError"]),
        (dict(methods=method("sac", policy_kwargs="dict(net_arch=[8")), ["M on Pendulum-v1", "SyntaxError"]),
        (dict(methods=method("td3", learning_rate="linear")), ["M on Pendulum-v1", "ValueError"]),
        (dict(methods=method("td3", noise_type="loud", noise_std=0.1)), ["M on Pendulum-v1", "loud"]),
        (dict(methods=method("td3", train_freq=[1, "stepp"])), ["M on Pendulum-v1", "stepp"]),
        (dict(methods=method("td3", buffer_size=10.5)), ["M on Pendulum-v1", "TypeError"]),
        (dict(methods=method("ppo", n_steps=1)), ["M on Pendulum-v1", "n_steps"]),
        (dict(methods=method("td3"), tasks=["Pendulum-v1", "CartPole-v1"]), ["M on CartPole-v1", "Box"]),
        (dict(methods=method("td3", env_wrapper="no.Wrapper")), ["M on Pendulum-v1", "ModuleNotFoundError"]),
    ],
)
def test_values_are_checked_before_any_run_starts(tmp_path, monkeypatch, changes, words):
    """... and before the study is made, so that the mended file needs no other name."""
    monkeypatch.setattr("benchmark.sweeps.execution.start_workers", lambda *args: pytest.fail("it trains"))
    places = ["--results", str(tmp_path / "results"), "--storage", f"sqlite:///{tmp_path}/studies.db"]
    with pytest.raises(SystemExit) as error:
        main([write_sweep(tmp_path, **changes), *places])
    assert all(word in str(error.value) for word in ["mine.yml", "no model can be made", *words]), str(error.value)
    assert open_storage(f"sqlite:///{tmp_path}/studies.db").get_all_studies() == []


@pytest.mark.parametrize("name", ["e1", "e3", "e4", "e5", "e6", "e7", "e8"])
def test_the_papers_sweeps_have_values_that_their_methods_take(name):
    check_values(load_sweep(name, {"tasks": ["Pendulum-v1"]}))


def test_checked_values_need_neither_memory_nor_files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    sizes = []
    monkeypatch.setattr("stable_baselines3.TD3._setup_model", lambda self: sizes.append(self.buffer_size))
    for changes in (method("td3", buffer_size=10**12), method("td3"), method("td3", buffer_size=50)):
        check_values(load_sweep(write_sweep(tmp_path, methods=changes)))
    assert sizes == [10_000, 10_000, 50]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine.yml"]


def test_mistakes_end_the_command_with_what_is_allowed(tmp_path):
    common = ["--results", str(tmp_path), "--storage", f"sqlite:///{tmp_path}/studies.db"]
    for argv, words in [
        (["e9"], "must be one of e1"),
        (["e3", "--task", "Pendulum-v7"], "Pendulum-v1"),
        (["e3", "--methods", "SAC"], "CGP-Online"),
        (
            ["e3", "--set", "gama=1"],
            "the command line: gama: no hyperparameter of CGP-Online (cgp), which must be one of gamma",
        ),
        (["e3", "--steps", "10", "--eval-interval", "11"], "must be at most `steps`, 10"),
        (["e3", "--grace", "10"], "The value of `grace` is 10.0, but must be more than two heartbeats of 5.0 seconds"),
        (["e2", "--study", "mine"], "is 5 sweeps"),
        (["e3", "--storage", "nonsense"], "storage"),
        (["e3", "--storage", "grpc://localhost"], "port"),
        (["e3", "--storage", "sqlite://"], "in the memory of one process"),
        (["e3", "--study", "my/study"], "must be the name of a folder"),
        (["e3", "--storage", f"sqlite:///{__file__}/x/studies.db"], "Not a directory"),
        (["e3", "--gym-packages", "no_such_package"], "no_such_package"),
    ]:
        with pytest.raises(SystemExit) as error:
            main([argv[0], *common, *argv[1:]])
        assert words in str(error.value)


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


def test_where_databases_are_is_not_recorded():
    argv = ["e8", "--storage", "postgresql://me:secret@host/db", "--seeds", "1", "--logs=here", "--results", "there"]
    sweep, _ = of_command_line(*SMALL)
    assert describe(sweep, argv, "cpu")["commands"][0]["command"] == "python -m benchmark.sweep e8 --seeds 1"
    with pytest.raises(SystemExit):
        # An abbreviation would be recorded
        parse(["e8", "--stor", "postgresql://me:secret@host/db"])


def test_records_come_back(tmp_path):
    records = [
        Record("e3", "A", "Pendulum-v1", {"x": 0.5, "y": "z"}, 3, 10, [5, 10], [1.5, 2.0], 2.5, None, 1.0),
        Record("e3", "B", "Pendulum-v1", {}, 0, 10, [], [], None, "ValueError: NaN", None),
    ]
    write_records(tmp_path, records)
    assert sorted(read_records(tmp_path), key=str) == sorted(records, key=str)


def test_the_description_is_plain_data_and_names_each_configuration():
    sweep = load_sweep("e3")
    description = describe(sweep, [], "cpu")
    assert json.loads(json.dumps(description)) == description
    assert set(description["configurations"]) == {run.configuration for run in sweep.runs()}
    assert description["runs_planned"] == 96
