"""``python -m benchmark.checkpoint``: full replay buffers. Times themselves are not tested."""

import gymnasium as gym
import numpy as np
from measuring_commands import run_command
from stable_baselines3.common.buffers import ReplayBuffer

from benchmark.speed import checkpoints


def test_a_checkpoint_is_of_a_full_buffer_and_of_all_steps_since_the_last(tmp_path, monkeypatch):
    steps = []
    save = checkpoints.StateStore.save

    def counting(self, step, state):
        steps.append(step)
        return save(self, step, state)

    monkeypatch.setattr(checkpoints.StateStore, "save", counting)
    options = "--env Pendulum-v1 --transitions 200 --new 10 --rounds 2 --device cpu"
    record = run_command("checkpoint", tmp_path, *options.split())
    assert steps == [0, 10, 20, 30, 40, 50]
    seconds = record["measured"]["seconds"]
    assert list(seconds) == ["first", "second", "later", "load"]
    assert all(len(each["all"]) == 2 and min(each["all"]) > 0.0 for each in seconds.values())
    # 200 transitions of 3 + 3 + 1 + 1 numbers, at the least
    assert record["measured"]["bytes"] > 200 * 8 * 4
    assert "a replay buffer of 200 transitions" in (tmp_path / "checkpoint.md").read_text()


def test_a_buffer_is_filled_around_its_end():
    buffer = ReplayBuffer(10, gym.spaces.Box(-1, 1, (2,)), gym.spaces.Box(-1, 1, (1,)))
    generator = np.random.default_rng(0)
    checkpoints.fill(buffer, 7, generator)
    assert (buffer.pos, buffer.full) == (7, False)
    before = buffer.rewards.copy()
    checkpoints.fill(buffer, 5, generator)
    assert (buffer.pos, buffer.full) == (2, True)
    changed = (buffer.rewards != before).ravel()
    assert changed.tolist() == [True] * 2 + [False] * 5 + [True] * 3
