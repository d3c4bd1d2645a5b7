"""The replay buffer of a population: each agent samples its own transitions."""

import numpy as np
import pytest
import torch as th
from environments import Doubles
from populations import make
from stable_baselines3.common.utils import set_random_seed

from sb3_cgp.fast.device_replay import DeviceReplayBuffer
from sb3_cgp.population.replay import copied_column, sample_columns


@pytest.mark.parametrize("n_steps", [1, 3])
def test_each_agent_samples_its_own_column(n_steps):
    population = make([dict(gamma=0.9), dict(gamma=0.5), dict(gamma=0.1)], n_steps=n_steps)
    buffer = population.replay_buffer
    for row in range(40):
        state = np.repeat(100.0 * np.arange(3) + row, 3).reshape(3, 3)
        ends = np.array([row % 7 == 6, False, row % 5 == 4])
        infos = [{"TimeLimit.truncated": bool(end) and index == 2} for index, end in enumerate(ends)]
        buffer.add(state, state + 0.5, np.full((3, 2), row / 100), np.arange(3) + 1.0, ends, infos)
    batch = sample_columns(buffer, 200, population._numbers.gammas)
    rows = batch.observations[:, :, 0] - 100 * th.arange(3).unsqueeze(1)
    assert ((rows >= 0) & (rows < 40)).all()
    assert batch.observations.shape == batch.next_observations.shape == (3, 200, 3)
    # Every row is drawn, and agents draw different ones
    assert all(len(own.unique()) > 35 for own in rows)
    assert not th.equal(rows[0], rows[1])
    th.testing.assert_close(batch.actions, (rows / 100).unsqueeze(2).expand(-1, -1, 2).float())
    for agent, gamma in enumerate((0.9, 0.5, 0.1)):
        for row, done, reward, discount, next_row in zip(
            rows[agent].int().tolist(), batch.dones[agent], batch.rewards[agent],
            batch.discounts[agent].expand(200), batch.next_observations[agent, :, 0] - 100 * agent - 0.5, strict=True,
        ):  # fmt: skip
            period = (7, 1_000, 5)[agent]
            length = min(n_steps, period - row % period, 40 - row)
            assert next_row == row + length - 1
            assert done == (agent == 0 and (row + length) % 7 == 0)
            assert reward.item() == pytest.approx((agent + 1) * sum(gamma**k for k in range(length)), rel=1e-5)
            assert discount.item() == pytest.approx(gamma**length, rel=1e-5)


def test_a_buffer_on_the_networks_device_gives_the_same_samples_and_columns():
    population = make(3).learn(3 * 40)
    host = population.replay_buffer
    device = DeviceReplayBuffer(3 * 500, Doubles.observation_space, Doubles.action_space, device="cpu", n_envs=3)
    for name in device.row_fields:
        getattr(device, name)[:] = th.as_tensor(getattr(host, name))
    device.pos = host.pos
    set_random_seed(1)
    expected = sample_columns(host, 30, population._numbers.gammas)
    set_random_seed(1)
    for field, value in zip(sample_columns(device, 30, population._numbers.gammas), expected, strict=True):
        assert th.equal(field.float(), value.float())
    own = copied_column(device, 2)
    assert (type(own), own.n_envs, own.size()) == (DeviceReplayBuffer, 1, 40)
    assert th.equal(own.actions[:40, 0], th.as_tensor(host.actions[:40, 2]))
    own.actions[:] = 7
    assert not (device.actions == 7).any()
    assert own.sample(5).actions.shape == (5, 2)
