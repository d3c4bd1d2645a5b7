"""What is left of a training that a fault or a signal has ended: it resumes to the bit."""

import errno
import os
import signal
import stat
from pathlib import Path

import numpy as np
import pytest
from faulty_environments import SMALL, Failing, assert_buried, raise_error, with_observation, with_reward
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import SubprocVecEnv
from trainings import Do

from sb3_cgp import CGP
from sb3_cgp.resumption import RestorableEnv
from sb3_cgp.resumption.callbacks import TrainingCheckpointCallback
from sb3_cgp.resumption.store import StateStore


def learn(folder, fault=None, at=73, model=None, function=None):
    """Train for 150 steps, the state saved after every 20, with a fault of the environment or of the process."""
    model = CGP("MlpPolicy", Failing(fault, at), **SMALL, seed=0) if model is None else model
    return model.learn(150, [TrainingCheckpointCallback(20, folder), Do(at if function else None, function)])


def assert_resumes(folder, step, expected):
    """The newest state is that of a step, and the training goes on to the end that it would have had."""
    assert max(StateStore(folder).steps()) == step
    model = learn(folder, model=CGP.resume(folder, Failing()))
    assert model.num_timesteps == 150
    for name, parameter in expected.policy.state_dict().items():
        np.testing.assert_array_equal(model.policy.state_dict()[name].numpy(), parameter.numpy(), err_msg=name)


def test_the_last_state_resumes_after_an_environment_has_raised(tmp_path):
    with pytest.raises(ZeroDivisionError, match=r"^the simulator is unstable$"):
        learn(tmp_path / "failed", raise_error)
    assert_resumes(tmp_path / "failed", 60, learn(tmp_path / "straight"))


@pytest.mark.parametrize("fault", [with_observation(np.full(3, np.nan)), with_observation(np.ones(1)), with_reward(None)])
def test_the_last_state_resumes_after_a_value_was_refused(fault, tmp_path):
    with pytest.raises(ValueError, match="The environment returned"):
        learn(tmp_path / "failed", fault)
    assert_resumes(tmp_path / "failed", 60, learn(tmp_path / "straight"))


# A state is a file of arrays, and one that names it
@pytest.mark.parametrize(("n_written", "last"), [(0, 60), (1, 60), (2, 80)])
def test_the_older_state_resumes_after_the_disk_was_full(n_written, last, tmp_path, monkeypatch):
    folder, expected = tmp_path / "failed", learn(tmp_path / "straight")
    written, fsync = [], os.fsync

    def fill(descriptor):
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            return
        written.append(descriptor)
        if len(written) > n_written:
            raise OSError(errno.ENOSPC, "No space left on device")
        fsync(descriptor)

    with pytest.raises(OSError, match=r"No space left on device.*: '.*failed/.*'") as caught:
        learn(folder, at=61, function=lambda: monkeypatch.setattr("os.fsync", fill))
    assert caught.value.errno == errno.ENOSPC
    assert Path(caught.value.filename).is_relative_to(folder)
    assert not [path for path in folder.rglob("*") if "partial" in path.name]
    monkeypatch.setattr("os.fsync", fsync)
    assert_resumes(folder, last, expected)


def test_sigterm_saves_the_state_and_ends_the_process(tmp_path):
    handler = signal.getsignal(signal.SIGTERM)
    with pytest.raises(SystemExit) as caught:
        learn(tmp_path / "stopped", function=lambda: os.kill(os.getpid(), signal.SIGTERM))
    assert caught.value.code == 143
    assert signal.getsignal(signal.SIGTERM) is handler
    assert_resumes(tmp_path / "stopped", 73, learn(tmp_path / "straight"))


@pytest.mark.usefixtures("heeds_interruptions")
def test_ctrl_c_saves_the_state_and_is_raised_by_learn(tmp_path, capfd):
    handler = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt, match=r"its state of step 73 is in .*stopped; `resume` continues it"):
        learn(tmp_path / "stopped", function=lambda: signal.raise_signal(signal.SIGINT))
    assert "saves its state and stops when this rollout is over. Press Ctrl-C again to stop at once" in capfd.readouterr().err
    assert signal.getsignal(signal.SIGINT) is handler
    assert_resumes(tmp_path / "stopped", 73, learn(tmp_path / "straight"))


@pytest.mark.usefixtures("heeds_interruptions")
def test_an_error_after_ctrl_c_is_not_hidden(tmp_path, monkeypatch):
    def fill_disk(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    def interrupt():
        monkeypatch.setattr(StateStore, "save", fill_disk)
        signal.raise_signal(signal.SIGINT)

    with pytest.raises(OSError, match="No space left"):
        learn(tmp_path, function=interrupt)


@pytest.mark.usefixtures("heeds_interruptions")
@pytest.mark.parametrize("wrapper", [RestorableEnv, Monitor])
def test_ctrl_c_that_ends_workers_too_keeps_the_last_state(wrapper, tmp_path):
    env = SubprocVecEnv([lambda: wrapper(Failing())] * 2, start_method="fork")

    def interrupt():
        for process in env.processes:
            os.kill(process.pid, signal.SIGINT)
            process.join(30)
        signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt, match="its state of step 20 is in"):
        CGP("MlpPolicy", env, **SMALL).learn(300, [TrainingCheckpointCallback(20, tmp_path), Do(15, interrupt)])
    assert StateStore(tmp_path).load()[0] == 20
    assert_buried(env)
