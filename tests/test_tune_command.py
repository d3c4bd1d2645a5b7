"""``python -m benchmark.tune``: mistakes, what it writes, and what it says at its end."""

import os
import subprocess
import sys
from pathlib import Path

import optuna
import pytest
import rl_zoo3.train
import yaml
from optuna.storages import InMemoryStorage
from optuna.trial import TrialState
from rl_zoo3 import ALGOS
from tunings import TINY_CGP, arguments

from benchmark import tune
from benchmark.sweeps import tune_execution
from benchmark.sweeps.tuner import Tuner

REPOSITORY = Path(__file__).resolve().parent.parent


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["--env", "Pendulum-v0"], "must be a registered environment"),
        (["--conf-file", "others.yml"], "Hyperparameters not found"),
        (["--conf-file", "missing.yml"], "The file of hyperparameters missing.yml cannot be read: No such file"),
        (["--conf-file", "objects.py"], "The hyperparameters of td3 for Pendulum-v1 are no plain data"),
        (["--storage", "studies.db"], "must be a database's URL"),
        (["--storage", "sqlite://"], "in the memory of one process"),
        (["--study", "my/study"], "must be the name of a folder"),
        (["--write", "."], "is a folder, and must be a YAML file"),
        (["--write", "list.yml"], "list.yml is not changed: it must be a mapping of tasks to their entries"),
        (["--storage", "sqlite:///text.yml/x/studies.db"], "Error: .*Not a directory"),
        (["--env", "no_such_package:Env-v0"], "no_such_package"),
        (["--gym-packages", "no_such_package"], "no_such_package"),
        (["--conf-file", "text.yml"], "target_noise_clip: '5e-1' of the tuned method .td3. is text in YAML"),
        (["--set", "train_freq=[1, stepp]"], "The tuned configurations: no model can be made: .*stepp"),
        (["--algo", "cgp", "--set", "target_policy_noise=-1"], "no model can be made: .*`target_policy_noise`"),
        (["--storage", "postgresql://127.0.0.1:1/x"], r"Error: the storage does not answer: .*127\.0\.0\.1.*continues\."),
    ],
)
def test_mistakes_end_the_command(tmp_path, monkeypatch, argv, message):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("benchmark.sweeps.storages.TABLES_TIMEOUT", 0.0)
    Path("text.yml").write_text("default: {policy: MlpPolicy, n_timesteps: 100, target_noise_clip: 5e-1}")
    Path("list.yml").write_text("- 1")
    monkeypatch.setattr(tune, "tune", lambda *args: pytest.fail("it tunes"))
    Path("others.yml").write_text("Reacher-v5: {gamma: 0.9}")
    Path("objects.py").write_text("hyperparams = {'default': {'policy': object()}}")
    with pytest.raises(SystemExit, match=message):
        tune.main([*arguments(), "--logs", str(tmp_path), *argv])


def test_a_corrected_command_needs_no_other_study(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("mine.yml").write_text("Pendulum-v1: {policy: MlpPolicy}")
    started = []
    monkeypatch.setattr(tune, "tune", lambda *args: started.append(args) or sys.exit("started"))
    command = ["--algo", "td3", "--env", "Pendulum-v1", "--conf-file", "mine.yml", "--storage", "sqlite:///studies.db"]
    for argv, message in [
        (["--steps", "60", "--set", "learning_rat=0.1"], "learning_rat: no hyperparameter of the tuned method"),
        (["--set", "learning_rate=0.1"], "The hyperparameters of td3 for Pendulum-v1 have no n_timesteps: give --steps"),
        (["--steps", "60", "--set", "learning_rate=0.1"], "started"),
    ]:
        with pytest.raises(SystemExit, match=message):
            tune.main([*command, *argv])
    assert len(started) == 1


def test_the_command_writes_what_rl_zoo3_trains(tmp_path, monkeypatch):
    """From the command line, by two processes, to a training by rl_zoo3 with what was found."""
    conf_file = tmp_path / "mine.yml"
    more = ["--workers", "2", "--storage", f"sqlite:///{tmp_path}/studies.db", "--logs", str(tmp_path / "logs")]
    command = [sys.executable, "-m", "benchmark.tune", *arguments(algo="cgp", tiny=TINY_CGP), *more, "--write", str(conf_file)]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False, timeout=600)
    logs = [path.read_text()[-2000:] for path in (tmp_path / "logs").glob("*/worker-*.log")]
    assert done.returncode == 0, (done.stderr, logs)
    study = optuna.load_study(study_name="tune-cgp-Pendulum-v1", storage=f"sqlite:///{tmp_path}/studies.db")
    assert len(study.get_trials(states=[TrialState.COMPLETE])) >= 2
    entry = yaml.safe_load(conf_file.read_text())["Pendulum-v1"]
    assert (entry["batch_size"], entry["n_timesteps"], entry["cem_samples"]) == (8, 60, 8)
    assert entry["gamma"] == 1 - study.best_params["one_minus_gamma"]
    assert f"trial {study.best_trial.number}: mean of 2 seeds" in conf_file.read_text()
    argv = ["train", "--algo", "cgp", "--env", "Pendulum-v1", "--conf-file", str(conf_file), "-f", str(tmp_path / "zoo")]
    monkeypatch.setattr(sys, "argv", [*argv, "--device", "cpu", "--eval-freq", "30", "--eval-episodes", "1"])
    rl_zoo3.train.train()
    model = ALGOS["cgp"].load(tmp_path / "zoo" / "cgp" / "Pendulum-v1_1" / "Pendulum-v1.zip")
    assert 60 <= model.num_timesteps < 70
    assert (model.gamma, model.cem_samples) == (entry["gamma"], 8)


class Process:
    """A process that has ended."""

    def poll(self):
        return 0


@pytest.mark.parametrize(
    ("scores", "message"),
    [
        ([1.0, 3.0], None),
        ([1.0], r"All processes have ended too early: .*worker-\*\.log say why\. The same command continues\."),
        ([None, None], r"No configuration was scored: 2 of 2 configurations over \(0 pruned, 2 failed\)"),
    ],
)
def test_the_command_says_how_a_tuning_ended(tmp_path, monkeypatch, capsys, pretend, scores, message):
    """... when its processes, which this one stands for, have ended."""
    storage, left = InMemoryStorage(), iter(scores)
    monkeypatch.setattr(tune, "open_storage", lambda url: storage)

    def score(run):
        value = next(left)
        if value is None:
            raise FloatingPointError("NaN")
        return value

    pretend(score)

    def start_workers(command, n_workers, threads, folder):
        assert command[1:3] == ["-m", "benchmark.tune"]
        assert command[-2:] == ["--parent", str(os.getpid())]
        args = tune.parse(arguments("--logs", str(tmp_path), "--parent", str(os.getppid()), trials=len(scores), seeds=1))
        own = Tuner(storage, "tune-td3-Pendulum-v1", tune.tuning_of(args), 60.0)
        tune_execution.execute_trials(own, args)
        return [Process()]

    monkeypatch.setattr(tune_execution, "start_workers", start_workers)
    argv = arguments("--logs", str(tmp_path), "--write", str(tmp_path / "best.yml"), seeds=1)
    if message is not None:
        with pytest.raises(SystemExit, match=message):
            tune.main(argv)
        return
    tune.main(argv)
    assert "benchmark.tune, trial 1: mean of 1 seeds 3 (3)" in capsys.readouterr().out
    assert yaml.safe_load((tmp_path / "best.yml").read_text())["Pendulum-v1"]["batch_size"] == 8
