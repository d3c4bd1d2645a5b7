"""Runs of rl_zoo3 that are interrupted, and resumed in their folders, beside runs that are not."""

import signal
import subprocess
import sys
import time
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
import torch as th
from rl_zoo3.train import train
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import load_results
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from trainings import Interruption, assert_same

from sb3_cgp import CGP
from sb3_cgp.resumption.locks import FolderInUseError, FolderLock
from sb3_cgp.resumption.logs import cut_monitors
from sb3_cgp.resumption.store import StateStore
from sb3_cgp.zoo import registration as zoo
from sb3_cgp.zoo.resume import main
from sb3_cgp.zoo.run_folders import LOCK_FILE, interpreter

pytestmark = pytest.mark.usefixtures("short_episodes")

CHECKPOINT = "{'sb3_cgp.TrainingCheckpointCallback': dict(save_freq=64)}"


class Stop(BaseCallback):
    """Interrupts whichever training passes the step."""

    at = None

    def _on_step(self):
        if self.n_calls == Stop.at:
            raise Interruption
        return True


@pytest.fixture(autouse=True)
def _uninterrupted(monkeypatch):
    zoo.register()
    monkeypatch.setattr(Stop, "at", None)


def command(folder, *options, callbacks=CHECKPOINT, **params):
    """The command line of a small run."""
    small = dict(learning_starts=40, buffer_size=250, batch_size=8, cem_samples=8, cem_elites=2, gradient_steps=1)
    small |= dict(n_timesteps=330, policy_kwargs="dict(net_arch=[8])", callback=f"[{callbacks}]", train_freq=2) | params
    arguments = f"--algo cgp --env Pendulum-v1 --seed 3 --device cpu --num-threads 1 --log-folder {folder} "
    arguments += f"--tensorboard-log {folder}/tensorboard --eval-freq 76 --eval-episodes 2 --log-interval 1"
    return [*arguments.split(), *options, "-params", *(f"{name}:{value}" for name, value in small.items())]


def run_of(folder):
    return folder / "cgp" / "Pendulum-v1_1"


def start(monkeypatch, arguments):
    """Train in this process, as ``python -m rl_zoo3.train`` does."""
    monkeypatch.setattr(sys, "argv", ["train.py", *arguments])
    train()


def resume(run):
    """Resume in this process, as ``python -m sb3_cgp.zoo.resume`` does."""
    # TensorBoard puts a folder's files into the order of the second in their names
    time.sleep(1)
    main([str(run)])


def outcome(folder):
    """What a run leaves behind, but for times."""
    run = run_of(folder)
    found = {}
    for model in ("Pendulum-v1", "best_model"):
        parameters = CGP.load(run / f"{model}.zip", device="cpu").policy.state_dict()
        found |= {f"{model}.{name}": parameter.numpy() for name, parameter in parameters.items()}
    with np.load(run / "evaluations.npz") as evaluations:
        found |= {f"evaluations.{name}": values for name, values in evaluations.items()}
    for path in run.glob("*.monitor.csv"):
        rows = [line.split(",")[:2] for line in path.read_text().splitlines()[2:]]
        found[path.name] = np.array(rows, np.float64)
    (events,) = (folder / "tensorboard").glob("*/CGP_*")
    accumulator = EventAccumulator(str(events)).Reload()
    for tag in accumulator.Tags()["scalars"]:
        if not tag.startswith("time/"):
            found[tag] = np.array([(event.step, event.value) for event in accumulator.Scalars(tag)])
    return found


@pytest.mark.parametrize(
    ("options", "params", "stops"),
    [
        ((), {}, [230]),
        # Twice from the same state
        ((), {}, [70, 132, 129]),
        (("--progress", "--save-freq", "100"), {"normalize": "True", "n_envs": 2}, [84]),
        pytest.param((), {"policy_training": "'offline'"}, [230], marks=pytest.mark.slow),
    ],
    ids=["once", "thrice", "two-environments-normalised", "offline"],
)
def test_a_run_that_was_interrupted_ends_as_one_that_was_not(options, params, stops, monkeypatch, tmp_path):
    callbacks = f"{CHECKPOINT}, 'test_resume_zoo.Stop'"
    start(monkeypatch, command(tmp_path / "straight", *options, callbacks=callbacks, **params))
    arguments = command(tmp_path / "stopped", *options, callbacks=callbacks, **params)
    run = run_of(tmp_path / "stopped")
    # Another process's random numbers
    with monkeypatch.context() as patch:
        patch.setattr(Stop, "at", stops[0])
        with pytest.raises(Interruption):
            start(monkeypatch, arguments)
        saved = {path: path.read_bytes() for path in run.glob("*/*.yml")}
        for stop in stops[1:]:
            th.manual_seed(stop)
            patch.setattr(Stop, "at", stop)
            with pytest.raises(Interruption):
                resume(run)
    # Hyperparameters that have changed since are not the run's
    (tmp_path / "cgp.yml").write_text("Pendulum-v1: {n_timesteps: 10, policy: MlpPolicy}")
    monkeypatch.setattr(zoo, "hyperparams_folder", lambda: tmp_path)
    resume(f"{run}/")

    assert_same(outcome(tmp_path / "stopped"), outcome(tmp_path / "straight"))
    assert {path: path.read_bytes() for path in run.glob("*/*.yml")} == saved
    assert len(list((tmp_path / "stopped" / "cgp").iterdir())) == 1
    # Plots take the episodes in the order of their times
    assert load_results(str(run))["index"].is_monotonic_increasing or "n_envs" in params


def test_nothing_is_left_to_do_for_a_run_that_has_ended(monkeypatch, tmp_path, capsys):
    start(monkeypatch, command(tmp_path))
    run = run_of(tmp_path)

    def files():
        # Some versions of filelock open the file that they lock for writing; it is empty
        return {path: path.read_bytes() if path.name.endswith("lock") else path.stat().st_mtime_ns for path in run.rglob("*")}

    before = files()
    main([str(run)])
    assert "has ended: there is nothing to resume" in capsys.readouterr().out
    assert files() == before


def test_a_run_that_the_keyboard_interrupted_goes_on_although_it_has_a_model(monkeypatch, tmp_path):
    start(monkeypatch, command(tmp_path / "straight"))
    callbacks = f"{CHECKPOINT}, 'test_resume_zoo.Stop'"
    monkeypatch.setattr(Stop, "at", 180)
    monkeypatch.setitem(globals(), "Interruption", KeyboardInterrupt)
    start(monkeypatch, command(tmp_path / "stopped", callbacks=callbacks))
    assert (run_of(tmp_path / "stopped") / "Pendulum-v1.zip").exists()
    monkeypatch.setattr(Stop, "at", None)
    resume(run_of(tmp_path / "stopped"))
    assert_same(outcome(tmp_path / "stopped"), outcome(tmp_path / "straight"))


def test_a_run_that_a_signal_interrupts_at_its_last_step_has_ended(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(Stop, "at", 330)
    monkeypatch.setattr(Stop, "_on_step", lambda self: self.n_calls < Stop.at or signal.raise_signal(signal.SIGINT) is None)
    start(monkeypatch, command(tmp_path, callbacks=f"{CHECKPOINT}, 'test_resume_zoo.Stop'"))
    assert "interrupted at step" not in capsys.readouterr().out
    resume(run_of(tmp_path))
    assert "has ended: there is nothing to resume" in capsys.readouterr().out


def test_a_policys_training_that_the_keyboard_interrupted_goes_on(monkeypatch, tmp_path):
    monkeypatch.setattr("sb3_cgp.core.offline.ROUND", 10)
    options = dict(policy_training="'offline'", n_timesteps=100)
    start(monkeypatch, command(tmp_path / "straight", **options))
    # Behind the environment's 100 steps, within the policy's training
    monkeypatch.setattr(Stop, "at", 110)
    monkeypatch.setitem(globals(), "Interruption", KeyboardInterrupt)
    callbacks = f"{CHECKPOINT}, 'test_resume_zoo.Stop'"
    start(monkeypatch, command(tmp_path / "stopped", callbacks=callbacks, **options))
    assert CGP.load(run_of(tmp_path / "stopped") / "Pendulum-v1.zip").policy.inference == "cem"
    monkeypatch.setattr(Stop, "at", None)
    resume(run_of(tmp_path / "stopped"))
    assert_same(outcome(tmp_path / "stopped"), outcome(tmp_path / "straight"))


def test_a_run_that_was_killed_before_it_saved_its_last_model_goes_on(monkeypatch, tmp_path):
    """Its model is that of an earlier interruption, and its states reach the end."""
    start(monkeypatch, command(tmp_path))
    run = run_of(tmp_path)
    final = CGP.load(run / "Pendulum-v1.zip")
    final.num_timesteps, final._training_has_ended = 100, False
    final.save(run / "Pendulum-v1.zip")
    assert max(StateStore(run / "state").steps()) == 330
    resume(run)
    assert CGP.load(run / "Pendulum-v1.zip").num_timesteps == 330


def test_states_in_a_folder_of_the_users_choice_are_found(monkeypatch, tmp_path, capsys):
    states = tmp_path / "states"
    chosen = CHECKPOINT.replace("64", f"64, path='{states}'")
    start(monkeypatch, command(tmp_path / "straight", n_timesteps=100))
    monkeypatch.setattr(Stop, "at", 84)
    with pytest.raises(Interruption):
        start(monkeypatch, command(tmp_path / "stopped", callbacks=f"{chosen}, 'test_resume_zoo.Stop'", n_timesteps=100))
    monkeypatch.setattr(Stop, "at", None)
    resume(run_of(tmp_path / "stopped"))
    assert not (run_of(tmp_path / "stopped") / "state").exists()
    assert max(StateStore(states).steps()) == 100
    assert_same(outcome(tmp_path / "stopped"), outcome(tmp_path / "straight"))


def test_what_cannot_be_resumed_is_refused_with_what_to_do(monkeypatch, tmp_path, capsys):
    with pytest.raises(SystemExit, match="nowhere is no folder of a run of rl_zoo3"):
        main([str(tmp_path / "nowhere")])
    callbacks = f"{CHECKPOINT}, 'test_resume_zoo.Stop'"
    monkeypatch.setattr(Stop, "at", 26)
    with pytest.raises(Interruption):
        start(monkeypatch, command(tmp_path, callbacks=callbacks))
    with pytest.raises(SystemExit, match=r"Error: There is no state in .*state: .* anew, by the command in .*command\.txt"):
        main([str(run_of(tmp_path))])
    path = run_of(tmp_path) / "Pendulum-v1" / "args.yml"
    path.write_text(path.read_text().replace("cgp", "td3"))
    with pytest.raises(SystemExit, match=r"Error: .* is a run of `td3`, but only those of `cgp` can be resumed"):
        main([str(run_of(tmp_path))])


@pytest.mark.parametrize("error", [RuntimeError, TimeoutError, ValueError])
def test_a_state_that_cannot_be_taken_is_named_without_a_traceback(error, monkeypatch, tmp_path):
    monkeypatch.setattr(Stop, "at", 76)
    with pytest.raises(Interruption):
        start(monkeypatch, command(tmp_path, callbacks=f"{CHECKPOINT}, 'test_resume_zoo.Stop'"))
    before = (run_of(tmp_path) / "0.monitor.csv").read_bytes()

    def refuse(*args, **kwargs):
        raise error("process 7 on another host trains in this folder")

    monkeypatch.setattr(CGP, "resume", refuse)
    with pytest.raises(SystemExit, match=r"^Error: process 7 on another host trains in this folder$"):
        main([str(run_of(tmp_path))])
    assert (run_of(tmp_path) / "0.monitor.csv").read_bytes() == before


class Beside(BaseCallback):
    """Tries to resume the run that is training, as another process would."""

    folder, refused = None, None

    def _on_step(self):
        if self.n_calls == 76:
            with pytest.raises(FolderInUseError, match=r"is in use by another training: process \d+ on host"):
                FolderLock(Beside.folder, LOCK_FILE).acquire()
            Beside.refused = True
        return True


@pytest.mark.parametrize("checkpoint", ["", CHECKPOINT.replace("64", "100_000"), CHECKPOINT], ids=["none", "later", "some"])
def test_a_run_belongs_to_one_process_from_its_start_to_its_end(checkpoint, monkeypatch, tmp_path):
    """... with states or without, and before the first of them is saved."""
    monkeypatch.setattr(Beside, "folder", run_of(tmp_path))
    monkeypatch.setattr(Beside, "refused", None)
    callbacks = ", ".join(filter(None, [checkpoint, "'test_resume_zoo.Beside'"]))
    start(monkeypatch, command(tmp_path, callbacks=callbacks, n_timesteps=100))
    assert Beside.refused
    other = FolderLock(run_of(tmp_path), LOCK_FILE)
    other.acquire()
    (run_of(tmp_path) / "Pendulum-v1.zip").unlink()
    before = {path: path.read_bytes() for path in run_of(tmp_path).rglob("*") if path.is_file()}
    with pytest.raises(SystemExit, match=r"^Error: The folder .*Pendulum-v1_1 is in use by another training: process"):
        main([str(run_of(tmp_path))])
    assert {path: path.read_bytes() for path in run_of(tmp_path).rglob("*") if path.is_file()} == before
    other.release()


@pytest.mark.parametrize("error", [Interruption, KeyboardInterrupt])
def test_a_run_that_was_interrupted_says_how_it_is_continued_and_is_free(error, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(Stop, "at", 46)
    monkeypatch.setitem(globals(), "Interruption", error)
    arguments = command(tmp_path, callbacks=f"{CHECKPOINT}, 'test_resume_zoo.Stop'", n_timesteps=100)
    run = run_of(tmp_path)
    with pytest.raises(error) if error is not KeyboardInterrupt else nullcontext():
        start(monkeypatch, arguments)
    stopped = "The run was interrupted at step 46 of 100."
    assert f"{stopped} It cannot be continued, as no state of it was saved in {run / 'state'}." in capsys.readouterr().out
    # rl_zoo3 saves a model after Ctrl-C
    reason = "interrupted at step 46 of 100, before it saved a state" if error is KeyboardInterrupt else "There is no state in"
    with pytest.raises(SystemExit, match=reason):
        resume(run)
    monkeypatch.setattr(Stop, "at", 84)
    with pytest.raises(error) if error is not KeyboardInterrupt else nullcontext():
        start(monkeypatch, arguments)
    second = run.with_name("Pendulum-v1_2")
    command_line = f"{interpreter()} -m sb3_cgp.zoo.resume {second}"
    advice = f"interrupted at step 84 of 100. Continue it, from step 64, by\n  {command_line}\n"
    assert advice in capsys.readouterr().out
    monkeypatch.setattr(Stop, "at", None)
    resume(second)
    said = capsys.readouterr().out
    assert f"Resuming the training in {second / 'state'} at step 64" in said
    assert f"{second} has ended at step 100: its final model is {second / 'Pendulum-v1.zip'}" in said
    assert "interrupted" not in said


@pytest.mark.parametrize("checkpoint", [CHECKPOINT, ""], ids=["with states", "without"])
def test_a_run_that_a_callback_ends_has_ended(checkpoint, monkeypatch, tmp_path, capsys):
    """It is not interrupted: its final model stays as it is."""
    stop = "{'stable_baselines3.common.callbacks.StopTrainingOnMaxEpisodes': dict(max_episodes=4)}"
    start(monkeypatch, command(tmp_path, callbacks=", ".join(filter(None, [checkpoint, stop]))))
    model = run_of(tmp_path) / "Pendulum-v1.zip"
    before = model.read_bytes()
    assert CGP.load(model).num_timesteps < 330
    assert "interrupted" not in capsys.readouterr().out
    resume(run_of(tmp_path))
    assert "has ended: there is nothing to resume" in capsys.readouterr().out
    assert model.read_bytes() == before


def test_a_run_without_states_is_as_it_was_before(monkeypatch, tmp_path):
    start(monkeypatch, command(tmp_path, callbacks=""))
    assert not (run_of(tmp_path) / "state").exists()


HEADER = '#{"t_start": 5.0, "env_id": "None"}\nr,l,t\n'


@pytest.mark.parametrize(
    ("n_episodes", "n_steps", "left"), [(2, 0, 2), (0, 999, 0), (9, 0, 3), (None, 599, 2), (None, 600, 3), (None, 199, 0)]
)
def test_episodes_after_the_state_are_cut_off_and_others_are_appended_behind(n_episodes, n_steps, left, tmp_path):
    rows = ["-1.0,200,1.5\n", "-2.0,200,2.5\n", "-3.0,200,3.5\n"]
    path = tmp_path / "0.monitor.csv"
    path.write_text(HEADER + "".join(rows) + "-4.0,2")
    with open(path, "a") as file:
        cut_monitors(path, n_episodes, n_steps)
        file.write("-9.0,200,9.5\n")
    assert path.read_text() == HEADER + "".join(rows[:left]) + "-9.0,200,9.5\n"


def python(*arguments):
    return subprocess.Popen([sys.executable, "-m", *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def n_episodes(folder):
    path = run_of(folder) / "0.monitor.csv"
    return max(len(path.read_text().splitlines()) - 2, 0) if path.exists() else 0


def descendants_of(pid):
    """List a process's children, theirs, and so on."""
    parents = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            # The name before it, in brackets, may hold anything
            parents[int(path.parent.name)] = int(path.read_text().rpartition(")")[2].split()[1])
        except FileNotFoundError:
            continue
    found = [child for child, parent in parents.items() if parent == pid]
    return [*found, *(each for child in found for each in descendants_of(child))]


def wait_until_gone(pids, timeout=10):
    end = time.monotonic() + timeout
    while left := [pid for pid in pids if Path(f"/proc/{pid}").exists()]:
        assert time.monotonic() < end, left
        time.sleep(0.05)


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs Linux to list processes")
@pytest.mark.parametrize("vec_env", ["dummy", "subproc"])
@pytest.mark.parametrize(("number", "status"), [(signal.SIGKILL, -9), (signal.SIGTERM, 143)])
def test_a_process_that_was_killed_is_resumed_by_the_command(number, status, vec_env, tmp_path):
    arguments = ["--vec-env", vec_env]
    # Long enough to be met on its way
    params = {"n_timesteps": 3_000}
    straight = python("rl_zoo3.train", *command(tmp_path / "straight", *arguments, **params))
    assert straight.wait() == 0, straight.stdout.read()
    killed = python("rl_zoo3.train", *command(tmp_path / "killed", *arguments, **params))
    while n_episodes(tmp_path / "killed") < 3:
        assert killed.poll() is None, killed.stdout.read()
        time.sleep(0.001)
    others = descendants_of(killed.pid)
    # Two workers, for training and evaluation, and the two processes that Python starts them by
    assert len(others) == (4 if vec_env == "subproc" else 0)
    killed.send_signal(number)
    assert killed.wait() == status, killed.stdout.read()
    assert 0 < max(StateStore(run_of(tmp_path / "killed") / "state").steps()) < 3_000
    wait_until_gone(others)
    resumed = python("sb3_cgp.zoo.resume", str(run_of(tmp_path / "killed")))
    output, _ = resumed.communicate()
    assert resumed.returncode == 0, output
    assert "Resuming" in output
    assert_same(outcome(tmp_path / "killed"), outcome(tmp_path / "straight"))
