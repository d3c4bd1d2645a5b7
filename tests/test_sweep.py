"""The command `python -m benchmark.sweep`: its options, sweep files' values, and what it records."""

import json
import math
from dataclasses import asdict, replace

import pytest
import yaml
from sweep_commands import SMALL, of_command_line

from benchmark import tune, worker
from benchmark.common.arguments import hyperparameter
from benchmark.common.records import RUNS, Record, read_records, write_records
from benchmark.sweep import main, parse
from benchmark.sweeps.checks import check_values
from benchmark.sweeps.execution import describe
from benchmark.sweeps.experiments import load_sweep, study_name
from benchmark.sweeps.storages import open_storage

pytestmark = pytest.mark.usefixtures("in_tmp_path")


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
        (dict(methods=method("td3", learning_rate="lin_ear")), ["M on Pendulum-v1", "ValueError"]),
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


def test_runs_that_learn_nothing_or_are_longer_than_the_others_are_warned_of(tmp_path, capsys):
    def warnings(name, **hyperparams):
        path = write_sweep(tmp_path, methods=method(name, **hyperparams), steps=100, evaluation_interval=50)
        check_values(load_sweep(path))
        return capsys.readouterr().err

    assert "M learns nothing, as all of its 100 steps are random (learning_starts=100)" in warnings("td3", learning_starts=100)
    assert "M trains for 128 steps in place of 100, as 64 are between its updates" in warnings("ppo", n_steps=64)
    assert warnings("td3", learning_starts=99) == warnings("ppo", n_steps=50) == warnings("random") == ""


def test_checked_values_need_neither_memory_nor_files(tmp_path, monkeypatch):
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


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"final": math.nan}, r"final: nan must be finite, or null with an error"),
        ({"final": "4"}, r"final: .* \(it is '4'\)"),
        ({"final": None}, r"final: None and error: None: one of them must be null, and the other one not"),
        ({"error": "ValueError"}, r"final: 4\.0 and error: 'ValueError': one of them must be null"),
        ({"returns": [1.0]}, r"returns: 1 must be as many as timesteps, 2"),
        ({"timesteps": [10, 5]}, r"timesteps: must ascend"),
        ({"timesteps": [5, 5]}, r"timesteps: must ascend"),
        ({"seed": "0"}, r"seed: .* \(it is '0'\)"),
        ({"steps": 99}, r"steps: 99 must be those of study\.json, 10"),
        ({"score": 1.0}, r"score: "),
    ],
)
def test_a_record_that_contradicts_itself_or_its_study_is_refused(tmp_path, changes, problem):
    good = Record("e", "A", "Pendulum-v1", {}, 0, 10, [5, 10], [math.nan, 2.0], 4.0, None, 1.0)
    lines = [json.dumps(asdict(good)), json.dumps(asdict(good) | {"seed": 1} | changes)]
    (tmp_path / RUNS).write_text("\n".join(lines))
    with pytest.raises(ValueError, match=rf"runs\.jsonl, line 2, is no record of a run: {problem}.*\. Move it away"):
        read_records(tmp_path, steps=10)


def test_a_run_is_read_once(tmp_path):
    """Files that were put together have lines twice."""
    good = Record("e", "A", "Pendulum-v1", {}, 0, 10, [5, 10], [math.nan, 2.0], 4.0, None, 1.0)
    write_records(tmp_path, [good, good])
    (record,) = read_records(tmp_path)
    assert record.key == good.key
    write_records(tmp_path, [good, replace(good, final=5.0)])
    with pytest.raises(
        ValueError, match=r"runs\.jsonl, lines 1 and 2, are different records of the run A,Pendulum-v1,seed=0\. Move it away"
    ):
        read_records(tmp_path)


def test_the_description_is_plain_data_and_names_each_configuration():
    sweep = load_sweep("e3")
    description = describe(sweep, [], "cpu")
    assert json.loads(json.dumps(description)) == description
    assert set(description["configurations"]) == {run.configuration for run in sweep.runs()}
    assert description["runs_planned"] == 96
