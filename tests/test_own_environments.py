"""Sweeps, tuning and reports on environments that a package of the user's registers, with ids that hold a slash."""

import importlib
import json
import os
import sys
from pathlib import Path

import gymnasium as gym
import pytest
import yaml
from huggingface_sb3 import EnvironmentName
from optuna.storages import InMemoryStorage
from rl_zoo3.utils import get_model_path

from benchmark import plan, report, sweep, tune
from benchmark.common.arguments import continuous_environment
from benchmark.common.environments import registered_environment, split_env_id
from benchmark.common.files import file_name
from benchmark.common.zoo import read_entry
from benchmark.reporting.figures import task_names
from benchmark.reporting.zoo_runs import Run as ZooRun
from benchmark.reporting.zoo_runs import find_run
from benchmark.sweeps.entries import write_entry
from benchmark.sweeps.experiments import load_sweep, study_name
from benchmark.sweeps.run import run_folder, train
from benchmark.sweeps.studies import Ledger
from benchmark.sweeps.validation import SweepError

MODULE = """
import gymnasium as gym
import numpy as np


class Short(gym.Env):
    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.n_steps = 0
        return self.observation_space.sample(), {}

    def step(self, action):
        self.n_steps += 1
        return self.observation_space.sample(), float(-abs(action[0])), self.n_steps == 5, False, {}


for name in ("mine/Short-v0", "mine-Short-v0", "Plain-v0"):
    gym.register(name, entry_point=Short)
"""
SLASH, DASH = "mine/Short-v0", "mine-Short-v0"
TINY = ["learning_starts=20", "batch_size=8", "buffer_size=100", "policy_kwargs=dict(net_arch=[8])"]
METHODS = {"TD3": {"algo": "td3", "hyperparams": {"policy": "MlpPolicy"}}}
GOOD = dict(title="A sweep", methods=METHODS, tasks=[SLASH], steps=40, seeds=1, evaluation_interval=20, evaluation_episodes=1)


def forget():
    """Have Gymnasium and Python know no environment of the package, as a new process does."""
    for name in ("short_envs", "other_envs"):
        sys.modules.pop(name, None)
    for name in (SLASH, DASH, "Plain-v0"):
        gym.registry.pop(name, None)


@pytest.fixture
def package(tmp_path, monkeypatch):
    """Write a package that registers environments, where this process and its children find it."""
    (tmp_path / "path").mkdir()
    for name in ("short_envs", "other_envs"):
        (tmp_path / "path" / f"{name}.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path / "path")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path / "path"), os.environ.get("PYTHONPATH", "")]))
    forget()
    yield "short_envs"
    forget()


@pytest.fixture
def file_of(tmp_path):
    """Write a sweep's file."""

    def write(**changes):
        path = tmp_path / "mine.yml"
        path.write_text(yaml.safe_dump(GOOD | changes))
        return str(path)

    return write


def runs_of(path, **overrides):
    return load_sweep(path, overrides).runs()


def test_a_sweep_of_a_packages_environment_from_its_file_to_its_page(package, file_of, tmp_path):
    """The processes that train import the package, too; rl_zoo3's scripts and our report find the run."""
    places = ["--logs", str(tmp_path / "logs"), "--results", str(tmp_path / "results"), "--device", "cpu"]
    storage = ["--storage", f"sqlite:///{tmp_path}/studies.db", "--set", *TINY]
    sweep.main([file_of(tasks=["Pendulum-v1"]), "--task", f"{package}:{SLASH}", *storage, *places])
    study = tmp_path / "results" / "mine-mine-Short-v0"
    (record,) = map(json.loads, (study / "runs.jsonl").read_text().splitlines())
    assert (record["task"], record["error"]) == (SLASH, None)
    assert (tmp_path / "results" / "figures" / study.name / "learning_curves_mine_Short-v0.png").is_file()
    assert f"| {SLASH} |" in (tmp_path / "results" / "results.md").read_text()
    logs = tmp_path / "logs" / study.name / "TD3"
    _, model_path, folder = get_model_path(1, str(logs), "td3", EnvironmentName(SLASH))
    assert Path(model_path).is_file()
    found = ZooRun("td3", EnvironmentName(SLASH), Path(folder), Path(model_path))
    assert (found.read_yaml("args.yml")["env"], found.read_yaml("args.yml")["gym_packages"]) == (SLASH, [package])
    for env_id in (SLASH, f"{package}:{SLASH}"):
        forget()
        report.main(["--algo", "td3", "--env", env_id, "--folder", str(logs), "--episodes", "1"])
        assert json.loads((Path(folder) / "report.json").read_text())["env"] == SLASH
    with pytest.raises(SystemExit, match=f"is a run on {SLASH}, and not on {DASH}"):
        report.main(["--algo", "td3", "--env", DASH, "--folder", str(logs)])


def test_a_process_that_tunes_imports_the_package(package, tmp_path, monkeypatch):
    monkeypatch.setattr("benchmark.sweeps.run.FINAL_EPISODES", 1)
    (tmp_path / "base.yml").write_text(yaml.safe_dump({SLASH: {"policy": "MlpPolicy", "n_timesteps": 40}}))
    common = ["--algo", "td3", "--trials", "1", "--seeds", "1", "--eval-episodes", "1", "--device", "cpu", "--set", *TINY]
    common += ["--conf-file", str(tmp_path / "base.yml"), "--logs", str(tmp_path), "--parent", str(os.getppid())]
    for number, argv in enumerate((["--env", f"{package}:{SLASH}"], ["--env", SLASH, "--gym-packages", package])):
        forget()
        storage = InMemoryStorage()
        monkeypatch.setattr(tune, "open_storage", lambda url, storage=storage: storage)
        tune.main([*argv, *common, "--study", f"study-{number}"])
        (trial,) = storage.get_all_trials(0)
        assert (trial.state.name, len(trial.user_attrs["scores"])) == ("COMPLETE", 1), trial.user_attrs
        assert (tmp_path / f"study-{number}" / "trial-0" / "td3" / "mine-Short-v0_1" / "mine-Short-v0.zip").is_file()


def test_a_run_names_the_packages_that_its_process_has_to_import(package, file_of, tmp_path):
    for changes, overrides in [
        (dict(tasks=[f"{package}:{SLASH}"]), {}),
        (dict(gym_packages=[package]), {}),
        (dict(gym_packages=[package], tasks=[f"{package}:{SLASH}"]), {}),
        ({}, {"gym_packages": [package]}),
        (dict(tasks=["Pendulum-v1"]), {"tasks": [f"{package}:{SLASH}"]}),
    ]:
        forget()
        (run,) = runs_of(file_of(**changes), **overrides)
        assert (run.task, run.gym_packages) == (SLASH, [package])
    forget()
    train(run, tmp_path / "run", lambda step, value: None, lambda step: None, "cpu")
    assert (tmp_path / "run" / "mine-Short-v0.zip").is_file()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (dict(gym_packages=["no_such_package"]), ["gym_packages", "must be modules that can be imported", "no_such_package"]),
        (dict(tasks=["no_such_package:Env-v0"]), ["gym_packages", "no_such_package"]),
        (dict(tasks=["a:b:Env-v0"]), ["tasks", "module:id"]),
        (dict(tasks=[":Env-v0"]), ["tasks", "module:id"]),
        (dict(tasks=["short_envs:Other-v0"]), ["tasks", "must be a registered environment"]),
        (dict(tasks=["Elsewhere-v0"]), ["tasks", "--gym-packages imports a package that registers one"]),
        (dict(tasks=["short_envs:Plain-v0", "other_envs:Plain-v0"]), ["tasks", "must differ"]),
        (dict(tasks=[SLASH, DASH], gym_packages=["short_envs"]), ["tasks", "have the same name in rl_zoo3's folders"]),
    ],
)
def test_mistakes_in_ids_are_named(package, file_of, changes, words):
    with pytest.raises(SweepError) as error:
        load_sweep(file_of(**changes))
    assert all(word in str(error.value) for word in ["mine.yml", *words]), str(error.value)


def test_a_package_that_the_command_line_names_wrongly(package, file_of):
    with pytest.raises(SweepError, match=r"the command line: gym_packages.*no_such_package"):
        load_sweep(file_of(), {"gym_packages": ["no_such_package"]})


def test_ids_with_a_slash_stay_within_their_folders(package, file_of, tmp_path):
    (run,) = runs_of(file_of(gym_packages=[package], methods={"My/TD3": METHODS["TD3"]}))
    folder = run_folder(tmp_path, "study", run)
    assert folder.relative_to(tmp_path).parts == ("study", "My%2FTD3", "td3", "mine-Short-v0_1")
    assert file_name("a/b") != file_name("a%2Fb")
    assert file_name("TD3,noise=0.1") == "TD3,noise=0.1"


def test_studies_are_named_as_folders_are():
    assert study_name("e8", None, [SLASH, "Pendulum-v1"]) == "e8-mine-Short-v0-Pendulum-v1"
    assert study_name("e8", None) == "e8"
    assert study_name("e8", "my study", [SLASH]) == "my study"
    for name in ("my/study", "..", "", "a\\b"):
        with pytest.raises(SweepError, match=r"--study: .* must be the name of a folder"):
            study_name("e8", name)


def test_no_run_overwrites_that_of_another_environment_with_the_same_name(package, file_of, tmp_path):
    """Neither in one study, nor in two of one name whose databases differ."""
    paths = {env_id: tmp_path / f"{number}.yml" for number, env_id in enumerate((SLASH, DASH))}
    for env_id, path in paths.items():
        path.write_text(yaml.safe_dump(GOOD | {"tasks": [env_id], "gym_packages": [package]}))
    slash, dash = (load_sweep(str(path)) for path in paths.values())
    storage = InMemoryStorage()
    Ledger(storage, "study").open(slash, {"experiment": "mine"})
    with pytest.raises(SweepError, match="has other methods, tasks or axes"):
        Ledger(storage, "study").open(dash, {"experiment": "mine"})
    (first,), (second,) = slash.runs(), dash.runs()
    folder = run_folder(tmp_path, "study", first)
    assert folder == run_folder(tmp_path, "study", second)
    folder.mkdir(parents=True)
    watch = lambda step: None  # noqa: E731
    train(first, folder, lambda step, value: None, watch, "cpu")
    before = (folder / "mine-Short-v0.zip").read_bytes()
    with pytest.raises(FileExistsError, match=f"holds a run on {SLASH}, and would hold one on {DASH}"):
        train(second, folder, lambda step, value: None, watch, "cpu")
    assert (folder / "mine-Short-v0.zip").read_bytes() == before


def test_tuning_distinguishes_environments_with_the_same_name(package, tmp_path):
    (tmp_path / "base.yml").write_text(yaml.safe_dump({"default": {"policy": "MlpPolicy", "n_timesteps": 40}}))
    common = ["--algo", "td3", "--conf-file", str(tmp_path / "base.yml"), "--gym-packages", package, "--env"]
    storage = InMemoryStorage()
    importlib.import_module(package)
    first, second = (tune.tuning_of(tune.parse([*common, env_id])) for env_id in (SLASH, DASH))
    assert (first.task, first.gym_packages) == (SLASH, [package])
    tune.Tuner(storage, "study", first, 60.0)
    with pytest.raises(SweepError, match=f"task: was '{SLASH}' and is now '{DASH}'"):
        tune.Tuner(storage, "study", second, 60.0)


def test_an_entry_of_an_id_with_a_slash_is_written_and_read(package, tmp_path):
    importlib.import_module(package)
    write_entry(tmp_path / "mine.yml", SLASH, {"gamma": 0.5, "policy": "MlpPolicy"}, "tuned")
    write_entry(tmp_path / "mine.yml", DASH, {"gamma": 0.6, "policy": "MlpPolicy"}, "tuned")
    entries = [read_entry("td3", env_id, str(tmp_path / "mine.yml"))["gamma"] for env_id in (SLASH, DASH)]
    assert entries == [0.5, 0.6]


def test_ids_are_split_as_gymnasium_splits_them(package):
    assert split_env_id("Env-v0") == ([], "Env-v0")
    assert split_env_id(f"{package}:{SLASH}") == ([package], SLASH)
    assert registered_environment(f"{package}:{SLASH}") == SLASH
    forget()
    # Measuring commands make the environment by the id alone
    assert continuous_environment(f"{package}:{SLASH}") == SLASH
    with pytest.raises(ValueError, match="cannot be imported"):
        registered_environment("no_such_package:Env-v0")


def test_figures_of_ids_whose_names_are_the_same_have_different_files():
    names = task_names(["a/Env-v0", "a_Env-v0", "ALE/Pong-v5"])
    assert names["ALE/Pong-v5"] == "ALE_Pong-v5"
    assert len(set(names.values())) == 3
    assert not any("/" in name for name in names.values())


def test_a_plan_names_what_rl_zoo3_takes(package, tmp_path, capsys):
    with pytest.raises(SystemExit, match='train ENV=mine/Short-v0 with ARGS="--gym-packages short_envs"'):
        plan.main(["--env", f"{package}:{SLASH}"])
    with pytest.raises(SystemExit, match="no_such_package"):
        plan.main(["--env", SLASH, "--gym-packages", "no_such_package"])
    (tmp_path / "cgp" / "mine-Short-v0_3").mkdir(parents=True)
    plan.main(["--env", SLASH, "--gym-packages", package, "--folder", str(tmp_path)])
    steps = read_entry("cgp", SLASH)["n_timesteps"]
    assert capsys.readouterr().out == f"{plan.evaluation_interval(int(steps))} 4\n"


def test_a_run_without_saved_arguments_is_one_on_the_environment_asked_for(tmp_path):
    folder = tmp_path / "td3" / "mine-Short-v0_1"
    folder.mkdir(parents=True)
    (folder / "mine-Short-v0.zip").touch()
    assert find_run(str(tmp_path), "td3", f"short_envs:{SLASH}").env_name.gym_id == SLASH
