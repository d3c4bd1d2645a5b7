"""What a resumed training shows its user: the step at which it goes on, a progress bar of the whole, and the command."""

import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from stable_baselines3.common.callbacks import BaseCallback, ProgressBarCallback

from sb3_cgp import CGP, TrainingCheckpointCallback
from sb3_cgp.zoo.run_folders import interpreter

TINY = dict(learning_starts=5, batch_size=4, buffer_size=200, policy_kwargs=dict(net_arch=[4]), device="cpu")


class Bars(BaseCallback):
    """Notes where the progress bar beside it begins, is after the first step, and ends."""

    # Arguments of a constructor are not part of a training's state
    def __init__(self, bar, found):
        super().__init__()
        self.bar, self.found = bar, found

    def _on_step(self):
        if not self.found:
            self.found += [self.bar.pbar.total, self.bar.pbar.initial, self.bar.pbar.n]
        self.last = self.bar.pbar.n
        return True


def stopped(folder, steps=20, verbose=0, before=0):
    """Train, as a script that is then stopped at the step."""
    model = CGP("MlpPolicy", "Pendulum-v1", verbose=verbose, **TINY)
    if before:
        model.learn(before)
    model.learn(steps, callback=TrainingCheckpointCallback(save_freq=10, path=folder), reset_num_timesteps=not before)
    return folder


@pytest.mark.filterwarnings("ignore:rich is experimental")
@pytest.mark.parametrize("before", [0, 12], ids=["first-training", "second-training"])
def test_the_progress_bar_shows_the_whole_training(before, tmp_path):
    stopped(tmp_path / "states", before=before)
    for done, total in ((20, 30), (30, 50)):
        bar = ProgressBarCallback()
        bars = Bars(bar, [])
        CGP.resume(tmp_path / "states", "Pendulum-v1").learn(total, callback=[bar, bars])
        # SB3 calls the bar first
        assert bars.found == [total, done, done + 1]
        assert bars.last == total


@pytest.mark.filterwarnings("ignore:rich is experimental")
def test_the_progress_bar_of_learn_does_so_too(tmp_path, monkeypatch):
    made = []
    start = ProgressBarCallback.__init__
    monkeypatch.setattr(ProgressBarCallback, "__init__", lambda self: (start(self), made.append(self))[0])
    CGP.resume(stopped(tmp_path / "states"), "Pendulum-v1").learn(30, progress_bar=True)
    (bar,) = made
    assert (bar.pbar.total, bar.pbar.initial, bar.pbar.n) == (30, 20, 30)
    # A training that is not resumed has SB3's own bar
    CGP("MlpPolicy", "Pendulum-v1", **TINY).learn(8, progress_bar=True)
    assert (made[1].pbar.total, made[1].pbar.initial) == (8, 0)


@pytest.mark.parametrize("verbose", [0, 1])
def test_the_step_of_the_resumption_is_printed_with_verbose(verbose, tmp_path, capsys):
    folder = stopped(tmp_path / "states", verbose=verbose)
    capsys.readouterr()
    CGP.resume(folder, "Pendulum-v1")
    assert (f"Resuming the training in {folder} at step 20\n" in capsys.readouterr().out) == bool(verbose)


@pytest.mark.parametrize("has_path", [True, False])
def test_the_command_that_continues_a_run_starts_this_interpreter(has_path, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", str(Path(sys.executable).parent) if has_path else "/nowhere")
    command = shlex.split(interpreter())
    assert (command == ["python"]) == has_path
    printed = subprocess.run([*command, "-c", "import sys; print(sys.prefix)"], capture_output=True, text=True, check=True)
    assert printed.stdout.strip() == sys.prefix


def test_an_interpreter_below_the_working_directory_is_named_by_a_relative_path(monkeypatch):
    monkeypatch.setenv("PATH", "/nowhere")
    monkeypatch.chdir(Path(sys.executable).parent.parent)
    assert interpreter() == os.path.join("bin", Path(sys.executable).name)
