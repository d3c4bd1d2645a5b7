"""The end of the last episode in a replay buffer."""

import numpy as np
import pytest
from guarded import located
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer

from sb3_cgp.common.replay_buffers import end_last_episode
from sb3_cgp.fast.device_replay import DeviceReplayBuffer
from sb3_cgp.guards.observations import continues_last_episode


def row(number):
    """A transition, its observation and reward, for the tests of a buffer alone."""
    here = np.full((2, 1), number, np.float32)
    return here, here + 1, np.zeros((2, 1), np.float32), np.full(2, number)


@pytest.mark.parametrize(("done", "timeout"), [(False, False), (True, False), (True, True)])
@pytest.mark.parametrize("n_rows", [1, 3, 5, 7])
def test_an_episode_that_had_ended_ends_as_it_had(done, timeout, n_rows):
    """Bootstrapping is that of the episode's own end: a timeout stays one."""
    env = located(2)
    buffer = NStepReplayBuffer(10, env.observation_space, env.action_space, n_envs=2, n_steps=3)
    for number in range(n_rows):
        is_last = number == n_rows - 1
        ends = np.array([False, done and is_last])
        buffer.add(*row(number), ends, [{}, {"TimeLimit.truncated": timeout and is_last}])
    end_last_episode(buffer)
    end_last_episode(buffer)
    last = buffer.pos - 1
    assert buffer.dones[last].tolist() == [1, 1]
    assert buffer.timeouts[last].tolist() == [1, float(timeout or not done)]
    assert buffer.dones.sum() == 2


def test_an_episode_ends_in_tensors_as_in_arrays():
    env = located(2)
    buffers = [
        each(10, env.observation_space, env.action_space, "cpu", n_envs=2) for each in (ReplayBuffer, DeviceReplayBuffer)
    ]
    for buffer in buffers:
        buffer.add(*row(0), np.array([False, True]), [{}, {"TimeLimit.truncated": True}])
        # The first environment's episode goes on, and the second one's new episode may start anywhere
        goes_on = np.array([[1, 1], [5, 5]], np.float32)
        assert continues_last_episode(buffer, goes_on)
        assert not continues_last_episode(buffer, goes_on + 1)
        end_last_episode(buffer)
        assert continues_last_episode(buffer, goes_on + 1)
    for name in ("dones", "timeouts"):
        np.testing.assert_array_equal(*(np.asarray(getattr(buffer, name)) for buffer in buffers))
        assert np.asarray(getattr(buffers[1], name))[0].tolist() == [1, 1]


def test_an_empty_buffer_stays_empty():
    env = located()
    for buffer_class in (ReplayBuffer, NStepReplayBuffer, DeviceReplayBuffer):
        buffer = buffer_class(10, env.observation_space, env.action_space)
        end_last_episode(buffer)
        assert buffer.dones.sum() == buffer.size() == 0
