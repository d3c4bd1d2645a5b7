"""Trainings that are killed at random moments, again and again, by a signal that no process can catch."""

import itertools
import os
import random
import signal
import time
from pathlib import Path

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from trainings import Training, assert_same, fingerprint

from sb3_cgp import CGP

pytestmark = pytest.mark.usefixtures("short_episodes")

SAVE_FREQ = 20
STEPS = 1_000


class Report(BaseCallback):
    """Tells the parent process how far the training is."""

    def __init__(self, progress):
        super().__init__()
        self.progress = progress

    def _on_step(self):
        os.write(self.progress, f"at {self.num_timesteps}\n".encode())
        return True


def train(folder, progress):
    """Go on with the training, or begin it, and write its result beside it."""
    training = Training(folder, steps=STEPS, save_freq=SAVE_FREQ)
    state = Path(folder) / "state"
    if list(state.glob("state-*.json")):
        model = CGP.resume(state, training.make_env(random.randrange(1000)))
    else:
        model = training.make_model()
    os.write(progress, f"from {model.num_timesteps}\n".encode())
    training.learn(model, None, Report(progress))
    np.savez(Path(folder) / "result", **fingerprint(training, model))


def killed_child(folder, draw):
    """
    Train in a child process, and kill it at a random moment, however fast it is: some time after some of its steps.

    :return: where it began, how far it came, and whether it ended before it was killed
    """
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        status = 1
        try:
            os.close(reading)
            th.set_num_threads(1)
            train(folder, writing)
            status = 0
        finally:
            os._exit(status)
    os.close(writing)
    with os.fdopen(reading) as reports:
        lines = list(itertools.islice(reports, draw.randrange(120)))
        time.sleep(draw.uniform(0.0, 0.05))
        os.kill(child, signal.SIGKILL)
        lines += reports
    _, status = os.waitpid(child, 0)
    begun = next((int(line.split()[1]) for line in lines if line.startswith("from")), None)
    reached = max((int(line.split()[1]) for line in lines if line.startswith("at")), default=begun)
    assert status in (0, signal.SIGKILL)
    return begun, reached, status == 0


def kill_again_and_again(folder, least):
    """
    Kill a training until it comes to its end.

    :return: how often, and how many steps it had to repeat each time that it went on
    """
    draw = random.Random(str(folder.name))
    kills, reached, repeated = 0, 0, []
    while True:
        begun, came_to, has_ended = killed_child(folder, draw)
        if begun is not None:
            # What is due at a step is saved before the next
            assert begun >= reached - SAVE_FREQ
            repeated.append(max(reached - begun, 0))
            reached = max(reached, came_to)
        if has_ended:
            return kills, repeated
        kills += 1
        assert kills < 20 * least, "it does not come to its end"


def check(tmp_path, least):
    undisturbed = Training(tmp_path / "straight", steps=STEPS, save_freq=SAVE_FREQ)
    expected = fingerprint(undisturbed, undisturbed.run())
    kills, repeated, n_trainings = 0, [], 0
    while kills < least:
        folder = tmp_path / str(n_trainings)
        folder.mkdir()
        more_kills, more_repeated = kill_again_and_again(folder, least)
        kills, repeated, n_trainings = kills + more_kills, repeated + more_repeated, n_trainings + 1
        with np.load(folder / "result.npz") as found:
            assert_same(dict(found), expected)
    print(f"\n{n_trainings} trainings of {STEPS} steps were killed {kills} times, and ended as one that was not. ", end="")
    print(f"Each time at most {max(repeated)} steps were repeated ({np.mean(repeated):.1f} on average).")


def test_killed_trainings_end_as_undisturbed_ones(tmp_path):
    check(tmp_path, least=10)


@pytest.mark.slow
def test_killed_a_hundred_times(tmp_path):
    check(tmp_path, least=100)
