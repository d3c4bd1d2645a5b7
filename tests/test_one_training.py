"""Folders of states that belong to one training at a time, states on other kinds of buffers, and copies of models."""

import copy
import errno
import gc
import os
import pickle
import stat
import subprocess
import sys
import textwrap
import warnings

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from environment_states import obstacles
from stable_baselines3 import TD3
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize
from trainings import SMALL, Do, Interruption, Stop, make_model

from sb3_cgp import CGP
from sb3_cgp.common.files import write_atomically
from sb3_cgp.fast.device_replay import DeviceReplayBuffer
from sb3_cgp.resumption import FolderInUseError, TrainingCheckpointCallback, resumable
from sb3_cgp.resumption.locks import NO_LOCKS, FolderLock
from sb3_cgp.resumption.replay_buffers import fill_replay_buffer, replay_buffer_state

IN_USE = r"in use by another training: process \d+ on host "


def env():
    return make_vec_env("Pendulum-v1", seed=1)


@pytest.fixture
def folder(tmp_path):
    make_model().learn(30, TrainingCheckpointCallback(10, tmp_path / "state"))
    return tmp_path / "state"


def test_a_second_model_of_the_process_is_refused_until_the_first_ends(folder):
    first = CGP.resume(folder, env())
    with pytest.raises(FolderInUseError, match=IN_USE):
        CGP.resume(folder, env())
    first.learn(40)
    second = CGP.resume(folder, env())
    assert second.num_timesteps == 40
    before = {path: path.stat().st_mtime_ns for path in (folder, *folder.iterdir())}
    with pytest.raises(FolderInUseError, match=IN_USE):
        first.learn(10, reset_num_timesteps=False, callback=TrainingCheckpointCallback(10, folder))
    # Nothing has been written to the folder
    assert {path: path.stat().st_mtime_ns for path in (folder, *folder.iterdir())} == before
    del second
    gc.collect()
    CGP.resume(folder, env())


def test_a_model_whose_states_another_one_has_continued_is_refused(folder):
    first = CGP.resume(folder, env())
    with pytest.raises(Interruption):
        first.learn(60, Stop(35))
    CGP.resume(folder, env()).learn(60)
    with pytest.raises(ValueError, match="a folder without the states of another training"):
        first.learn(60, TrainingCheckpointCallback(10, folder))


def test_another_process_is_refused_and_a_killed_one_does_not_block(folder):
    script = """
        import sys, time
        from sb3_cgp import CGP
        model = CGP.resume(sys.argv[1], "Pendulum-v1")
        print("resumed", flush=True)
        time.sleep(300)
    """
    other = subprocess.Popen([sys.executable, "-c", textwrap.dedent(script), str(folder)], stdout=subprocess.PIPE)
    assert other.stdout.readline() == b"resumed\n"
    with pytest.raises(FolderInUseError, match=rf"process {other.pid} on host "):
        CGP.resume(folder, env())
    other.kill()
    other.wait()
    CGP.resume(folder, env()).learn(40)


@pytest.mark.parametrize("number", NO_LOCKS)
@pytest.mark.parametrize("is_copied", [True, False])
def test_on_a_file_system_without_locks_nothing_is_left_that_blocks(is_copied, number, tmp_path, fail_to_lock):
    if is_copied:
        FolderLock(tmp_path).acquire()
        gc.collect()
        assert (tmp_path / ".lock").exists()
    fail_to_lock(number)
    for _ in range(2):
        # A killed process releases nothing
        lock = FolderLock(tmp_path)
        with pytest.warns(UserWarning, match=r"cannot be locked \(.*\): make sure that no other process uses it"):
            lock.acquire()
        assert not lock._lock.is_locked


@pytest.mark.parametrize("number", [errno.EACCES, errno.EPERM])
def test_a_lock_that_another_user_has_left_does_not_block(number, folder, monkeypatch):
    opened = os.open

    def refuse(path, *args, **kwargs):
        if os.fspath(path).endswith(".lock"):
            raise PermissionError(number, os.strerror(number), path)
        return opened(path, *args, **kwargs)

    monkeypatch.setattr("os.open", refuse)
    with pytest.warns(UserWarning, match=r"cannot be locked \(.*\.lock'\): make sure that no other process uses it"):
        model = CGP.resume(folder, env())
    assert model.learn(40).num_timesteps == 40


def test_other_users_can_lock_the_same_file(tmp_path):
    usual = os.umask(0o077)
    try:
        FolderLock(tmp_path).acquire()
    finally:
        os.umask(usual)
    assert stat.S_IMODE((tmp_path / ".lock").stat().st_mode) == 0o666


def test_a_folder_that_cannot_be_locked_for_another_reason_is_an_error(tmp_path, fail_to_lock):
    """With too many files open, two trainings would write to it."""
    fail_to_lock(errno.EMFILE)
    with pytest.raises(OSError, match="Too many open files"):
        make_model().learn(30, TrainingCheckpointCallback(10, tmp_path / "state"))


def test_an_error_lets_go_of_the_folder(folder):
    with pytest.raises(ValueError, match="num_envs"):
        CGP.resume(folder, make_vec_env("Pendulum-v1", n_envs=2))
    model = CGP.resume(folder, env())
    with pytest.raises(KeyboardInterrupt):
        model.learn(60, Do(5, lambda: (_ for _ in ()).throw(KeyboardInterrupt)))
    CGP.resume(folder, env())


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda model: pickle.loads(pickle.dumps(model))], ids=["copy", "pickle"])
def test_models_can_be_copied_whenever_those_of_td3_can(copied, tmp_path):
    model = make_model()
    assert copied(model).num_timesteps == 0
    callbacks = [TrainingCheckpointCallback(10, tmp_path), EvalCallback(env(), eval_freq=20, n_eval_episodes=1, verbose=0)]
    during = []
    model.learn(30, [*callbacks, Do(25, lambda: during.append(copy.deepcopy(model)))])
    assert model._training.callback is None
    assert during[0].num_timesteps == 25
    with pytest.raises(Interruption):
        model.learn(40, [Stop(35)], reset_num_timesteps=False)
    again = copied(model)
    assert again.learn(10, reset_num_timesteps=False).num_timesteps == model.num_timesteps + 10
    td3 = resumable(TD3)("MlpPolicy", env(), learning_starts=5, policy_kwargs=dict(net_arch=[4]), buffer_size=50).learn(10)
    assert copy.deepcopy(td3).num_timesteps == 10


def test_a_loaded_training_goes_on_before_the_policy_alone_is_trained(folder):
    with pytest.raises(ValueError, match="A training state has been loaded by `resume`: call `learn`"):
        CGP.resume(folder, env()).train_policy(10)


def make_buffer(cls, size=20, dtype=np.float32):
    space = make_vec_env("Pendulum-v1").observation_space
    space.dtype = np.dtype(dtype)
    return cls(size, space, make_vec_env("Pendulum-v1").action_space, "cpu")


def add(buffer, count):
    for number in range(count):
        buffer.add(*[np.full((1, 3), number)] * 2, np.zeros((1, 1)), np.array([number]), np.zeros(1), [{}])
    return buffer


@pytest.mark.parametrize("there", [ReplayBuffer, DeviceReplayBuffer])
@pytest.mark.parametrize("saved", [ReplayBuffer, DeviceReplayBuffer])
@pytest.mark.parametrize(("count", "size"), [(7, 20), (7, 7), (7, 12), (20, 20), (27, 20), (27, 30)])
def test_states_load_into_each_kind_of_buffer_and_other_sizes(saved, there, count, size):
    buffer = make_buffer(there, size)
    fill_replay_buffer(buffer, replay_buffer_state(add(make_buffer(saved), count)))
    assert (buffer.size(), buffer.buffer_size) == (min(count, 20), size)
    # From the oldest row, which the next one replaces in a full buffer, to the newest, which it continues
    in_order = np.roll(th.as_tensor(buffer.rewards).numpy().ravel(), -buffer.pos)[-buffer.size() :]
    assert np.array_equal(in_order, np.arange(max(count - 20, 0), count))
    add(buffer, 1)


def test_buffers_that_do_not_fit_are_refused_by_name():
    state = replay_buffer_state(add(make_buffer(ReplayBuffer), 9))
    with pytest.raises(ValueError, match="`buffer_size` is 8, but must be at least 9"):
        fill_replay_buffer(make_buffer(ReplayBuffer, 8), state)
    fill_replay_buffer(wide := make_buffer(ReplayBuffer, dtype=np.float64), state)
    assert wide.observations.dtype == np.float64
    wide.observations[0] = 0.1
    with pytest.raises(ValueError, match=r"`replay_buffer.observations` is 'of type float32', but must be of type float64"):
        fill_replay_buffer(make_buffer(ReplayBuffer), replay_buffer_state(wide))


def test_a_finished_offline_training_is_not_repeated(tmp_path, monkeypatch):
    monkeypatch.setattr("sb3_cgp.core.offline.ROUND", 10)
    model = make_model(policy_training="offline").learn(40, TrainingCheckpointCallback(10, tmp_path))
    resumed = CGP.resume(tmp_path, env())
    steps = []
    monkeypatch.setattr(CGP, "train_policy", lambda self, **_: steps.append(1))
    resumed.learn(40)
    assert steps == []
    pairs = zip(model.policy.state_dict().values(), resumed.policy.state_dict().values(), strict=True)
    assert all(ours.equal(theirs) for ours, theirs in pairs)


@pytest.mark.parametrize("exists", [True, False])
def test_a_symbolic_link_is_kept_and_its_target_written(tmp_path, exists):
    (tmp_path / "store").mkdir()
    target, link = tmp_path / "store" / "target.zip", tmp_path / "link.zip"
    if exists:
        target.write_bytes(b"old")
        target.chmod(0o640)
    link.symlink_to(target)
    write_atomically(link, b"new")
    assert link.is_symlink()
    assert target.read_bytes() == b"new"
    assert not exists or oct(os.stat(target).st_mode)[-3:] == "640"
    make_model().save(link)
    assert link.is_symlink()
    assert target.read_bytes()[:2] == b"PK"


def test_what_cannot_be_restored_is_said_at_the_first_state_with_all_obstacles(tmp_path):
    training, evaluation = env(), env()
    training.envs[0].unwrapped.first = training.envs[0].unwrapped.second = evaluation.envs[0].unwrapped.third = object()
    with pytest.warns(UserWarning, match="cannot be saved") as warned:
        make_model(env=training).learn(
            40, [TrainingCheckpointCallback(10, tmp_path), EvalCallback(evaluation, n_eval_episodes=1, verbose=0)]
        )
    messages = [str(each.message) for each in warned if "cannot be saved" in str(each.message)]
    assert len(messages) == 2
    assert "PendulumEnv.first" in messages[0]
    assert "PendulumEnv.second" in messages[0]
    assert "EvalCallback's `eval_env`" in messages[1]


class Settling(resumable(TD3)):
    """A model that brings its attributes and its log up to date when its state is saved."""

    settled = 0

    def _before_saving_state(self):
        super()._before_saving_state()
        self.settled = self.num_timesteps
        self.logger.record("settled", self.num_timesteps)


def test_a_model_updates_its_attributes_and_its_log_before_a_state_is_saved(tmp_path, monkeypatch):
    arguments = dict(learning_starts=5, policy_kwargs=dict(net_arch=[4]), buffer_size=50)
    monkeypatch.chdir(tmp_path)
    elsewhere = Do(3, lambda: monkeypatch.chdir("/"))
    Settling("MlpPolicy", env(), **arguments).learn(10, [TrainingCheckpointCallback(10, "state"), elsewhere])
    model = Settling.resume(tmp_path / "state", env())
    assert model.settled == 10
    assert model.resumption["logger"]["name_to_value"]["settled"] == 10
    model.learn(10)


def test_what_would_help_environments_in_other_processes():
    processes = make_vec_env("Pendulum-v1", vec_env_cls=SubprocVecEnv, vec_env_kwargs=dict(start_method="fork"))
    try:
        (problem,) = obstacles(processes)
    finally:
        processes.close()
    assert "Make sb3_cgp.resumption.RestorableEnv its outermost wrapper" in problem
    assert "needs get_training_state() and set_training_state(), or sb3_cgp.register_restorable, too" in problem


class OnlyGets(gym.Env):
    """Returns its state, and cannot restore it."""

    observation_space = gym.spaces.Box(-1, 1, (1,), np.float64)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1), {}

    def step(self, action):
        return np.zeros(1), 0.0, False, False, {}

    def get_training_state(self):
        return {}


def test_a_state_that_cannot_be_set_is_an_obstacle(tmp_path):
    model = CGP("MlpPolicy", OnlyGets(), policy_kwargs=dict(net_arch=[4]), **SMALL)
    with pytest.warns(UserWarning, match=r"OnlyGets has a get_training_state\(\) and no set_training_state\(\)"):
        model.learn(10, callback=TrainingCheckpointCallback(5, tmp_path))
    with pytest.warns(UserWarning, match="state was not saved"):
        CGP.resume(tmp_path, OnlyGets()).learn(15)


@pytest.mark.parametrize("was_normalized", [True, False])
def test_a_state_of_another_normalisation_is_refused_by_name(was_normalized, tmp_path):
    plain, normalizing = DummyVecEnv([OnlyGets]), VecNormalize(DummyVecEnv([OnlyGets]))
    before, after = (normalizing, plain) if was_normalized else (plain, normalizing)
    model = CGP("MlpPolicy", before, policy_kwargs=dict(net_arch=[4]), **SMALL)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model.learn(10, callback=TrainingCheckpointCallback(5, tmp_path))
    with pytest.raises(
        ValueError, match=f"`env` is .*, but must be {'' if was_normalized else 'not '}wrapped in VecNormalize"
    ):
        CGP.resume(tmp_path, after)
