"""What happens when an environment or the machine fails: the table of docs/trust.md, a test for each row."""

import errno
import multiprocessing
import os
import re
import signal
import stat
import threading
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
from environments import Doubles
from gymnasium import spaces
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnvWrapper, VecNormalize
from trainings import Do

from sb3_cgp import CGP
from sb3_cgp.guards.transitions import BoundsWatch, Transition
from sb3_cgp.resumption import RestorableEnv
from sb3_cgp.resumption.callbacks import TrainingCheckpointCallback
from sb3_cgp.resumption.store import StateStore

ROOT = Path(__file__).parent.parent

SMALL = dict(buffer_size=200, learning_starts=10, batch_size=8, cem_samples=8, cem_elites=2, policy_kwargs=dict(net_arch=[8]))

UNBOUNDED = spaces.Box(-np.inf, np.inf, (1,))


class Failing(Doubles):
    """Calls a function at a step, and returns what it makes of the step's five values."""

    def __init__(self, fault=None, at=15, observation_space=Doubles.observation_space):
        self.fault, self.at, self.total, self.steps = fault, at, 0, 0
        self.observation_space = observation_space

    def step(self, action):
        self.total += 1
        values = super().step(action)
        return values if self.fault is None or self.total != self.at else self.fault(*values)

    def get_training_state(self):
        return {"steps": self.steps, "total": self.total, "random": self.np_random.bit_generator.state}

    def set_training_state(self, state):
        self.steps, self.total = state["steps"], state["total"]
        self.np_random.bit_generator.state = state["random"]


def raise_error(*_):
    raise ZeroDivisionError("the simulator is unstable")


def kill_worker(*_):
    os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(60)


def with_observation(observation):
    return lambda _, *others: (observation, *others)


def with_reward(reward):
    return lambda observation, _, *others: (observation, reward, *others)


def subproc(*faults, start_method="fork"):
    # "fork" starts in milliseconds, SB3's default in seconds
    return SubprocVecEnv([lambda fault=fault: Failing(fault) for fault in faults], start_method=start_method)


def is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def assert_buried(env):
    """No worker is left, and closing the environment neither hangs nor raises."""
    assert not any(is_running(process.pid) for process in env.processes)
    assert multiprocessing.active_children() == []
    start = time.monotonic()
    env.close()
    assert time.monotonic() - start < 1
    assert not [thread for thread in threading.enumerate() if "_run" in thread.name]


@pytest.mark.parametrize("start_method", ["fork", "forkserver"])
@pytest.mark.parametrize("index", [0, 1])
def test_a_worker_that_is_killed_is_named_and_the_others_end(start_method, index):
    if start_method == "forkserver" and index == 0:
        pytest.skip("the second worker's death is seen in the same way")
    env = subproc(*[kill_worker if i == index else None for i in range(3)], start_method=start_method)
    pid = env.processes[index].pid
    model = CGP("MlpPolicy", env, **SMALL)
    message = (
        rf"died at environment step 42: of 3 workers, worker {index} \(process {pid}\) was killed by signal 9 \(Killed\)\."
    )
    with pytest.raises(RuntimeError, match=message) as caught:
        model.learn(300)
    assert isinstance(caught.value.__cause__, (EOFError, ConnectionError))
    assert_buried(env)


def ignore_termination(*values):
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    return values


def test_workers_that_do_not_heed_sigterm_are_ended_too(monkeypatch):
    """Forked after pygame has begun, they take SIGTERM for an event, and hold the dead one's pipe open."""
    monkeypatch.setattr("sb3_cgp.guards.workers.GRACE", 0.5)
    env = SubprocVecEnv([lambda: Failing(ignore_termination, at=1), lambda: Failing(kill_worker)], start_method="fork")
    with pytest.raises(RuntimeError, match="worker 1"):
        CGP("MlpPolicy", env, **SMALL).learn(300)
    assert_buried(env)


def test_an_exception_in_a_worker_is_printed_by_it_and_ends_the_training(capfd):
    env = subproc(None, raise_error)
    with pytest.raises(RuntimeError, match=r"at environment step 28: .* worker 1 .* ended with exit code 1\."):
        CGP("MlpPolicy", VecNormalize(env), **SMALL).learn(300)
    assert "ZeroDivisionError: the simulator is unstable" in capfd.readouterr().err
    assert_buried(env)


def test_a_worker_that_dies_during_a_gradient_step_is_named():
    env = subproc(None, None)
    model = CGP("MlpPolicy", env, **SMALL)
    with pytest.raises(RuntimeError, match=r"worker 1 .* was killed by signal 15"):
        model.learn(300, Do(20, env.processes[1].terminate))
    assert_buried(env)


def test_a_worker_that_dies_in_a_nested_training_is_named_alone():
    env = subproc(None, None, None)
    outer, inner = (CGP("MlpPolicy", env, **SMALL) for _ in range(2))
    message = r"of 3 workers, worker 1 \(process \d+\) was killed by signal 15 \(Terminated\)\. An"
    with pytest.raises(RuntimeError, match=message):
        outer.learn(300, Do(20, lambda: inner.learn(300, Do(20, env.processes[1].terminate))))
    assert_buried(env)


def test_a_worker_of_an_evaluation_that_dies_is_named():
    env, eval_env = subproc(None), subproc(kill_worker)
    with pytest.raises(RuntimeError, match=r"of 1 workers, worker 0 .* was killed by signal 9"):
        CGP("MlpPolicy", env, **SMALL).learn(300, EvalCallback(eval_env, eval_freq=20, n_eval_episodes=5, verbose=0))
    # The training's environment has not failed: it goes on, or is closed as usual
    assert env.processes[0].is_alive()
    assert not env.closed
    env.close()
    assert_buried(eval_env)


@pytest.mark.usefixtures("heeds_interruptions")
def test_an_interruption_from_the_keyboard_that_ends_workers_leaves_an_environment_that_closes():
    env = subproc(None, None)

    def interrupt():
        # As a terminal does, for every process in it
        for process in env.processes:
            os.kill(process.pid, signal.SIGINT)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        CGP("MlpPolicy", env, **SMALL).learn(300, Do(20, interrupt))
    assert_buried(env)


@pytest.mark.parametrize("vec_env", [DummyVecEnv, None], ids=["vectorised", "single"])
def test_an_exception_of_the_environment_reaches_the_user_unchanged(vec_env):
    env = Failing(raise_error) if vec_env is None else vec_env([lambda: Failing(raise_error)])
    model = CGP("MlpPolicy", env, **SMALL)
    with pytest.raises(ZeroDivisionError, match=r"^the simulator is unstable$"):
        model.learn(300)
    assert model.replay_buffer.size() == 14


@pytest.mark.parametrize("error", [EOFError, BrokenPipeError, ValueError, TypeError])
def test_an_error_of_the_environments_own_is_not_taken_for_a_fault_of_ours(error):
    def fail(*_):
        raise error("the simulator's own")

    with pytest.raises(error, match=r"^the simulator's own$"):
        CGP("MlpPolicy", Failing(fail), **SMALL).learn(300)


@pytest.mark.parametrize("shape", [(1,), (), (4,), (3, 1), (2, 3)], ids=str)
@pytest.mark.parametrize("at", [14, 15], ids=["within", "last"])
def test_an_observation_of_a_wrong_shape_is_refused(shape, at):
    # The last observation of an episode takes another way
    model = CGP("MlpPolicy", Failing(with_observation(np.ones(shape)), at), **SMALL)
    with pytest.raises(ValueError, match=r"wrong shape at environment step 1[3-5]: the (terminal )?observation has") as caught:
        model.learn(300)
    assert f"has shape {shape}, where (3,) is expected" in str(caught.value)
    assert model.replay_buffer.size() == at - 1


def test_an_observation_of_a_wrong_shape_is_refused_from_workers_too():
    env = subproc(with_observation(np.ones(1)))
    model = CGP("MlpPolicy", env, **SMALL)
    with pytest.raises(ValueError, match=r"wrong shape .* has shape \(1,\), where \(3,\) is expected"):
        model.learn(300)
    env.close()


def test_an_observation_that_numpy_stores_without_loss_is_taken():
    model = CGP("MlpPolicy", Failing(with_observation(np.full((1, 3), 7.0)), at=13), **SMALL)
    model.learn(20)
    assert np.all(model.replay_buffer.next_observations[12] == 7.0)
    # A training leaves the environment as it was
    assert "_save_obs" not in vars(model.env)


@pytest.mark.parametrize("reward", [np.ones(2), None, "high"], ids=str)
@pytest.mark.parametrize("monitored", [True, False])
def test_a_reward_that_is_no_number_is_refused(reward, monitored):
    wrapper = Monitor if monitored else lambda env: env
    model = CGP("MlpPolicy", DummyVecEnv([lambda: wrapper(Failing(with_reward(reward)))]), **SMALL)
    with pytest.raises(ValueError, match=r"returned a (reward that is not a number|NaN)|to float: 'high'"):
        model.learn(300)
    assert model.replay_buffer.size() == 14


@pytest.mark.parametrize("reward", [np.ones(2), None, "high"], ids=str)
def test_a_reward_that_is_no_number_is_refused_from_workers_too(reward):
    env = subproc(with_reward(reward))
    model = CGP("MlpPolicy", env, **SMALL)
    with pytest.raises(ValueError, match=r"the reward has shape|a reward that is not a number"):
        model.learn(300)
    assert model.replay_buffer.size() == 14
    env.close()


@pytest.mark.parametrize("fault", [with_observation(np.array([0, np.nan, 0])), with_reward(np.inf)])
@pytest.mark.parametrize("make_vec_env", [lambda fault: DummyVecEnv([lambda: Failing(fault)]), subproc])
def test_a_nan_is_refused_before_it_is_stored(fault, make_vec_env):
    env = make_vec_env(fault)
    model = CGP("MlpPolicy", env, **SMALL)
    with pytest.raises(ValueError, match=r"NaN or infinite .* at environment step 15"):
        model.learn(300)
    assert model.replay_buffer.size() == 14
    env.close()


@pytest.mark.filterwarnings("ignore:invalid value encountered")
@pytest.mark.parametrize("observation", [np.full(3, np.inf), np.full(3, -1e100), np.full(3, np.nan), np.ones(1)], ids=str)
@pytest.mark.parametrize("at", [14, 15], ids=["within", "last"])
def test_observations_are_checked_before_they_are_normalised(observation, at):
    """VecNormalize clips them, and broadcasts the last one of an episode."""
    env = VecNormalize(DummyVecEnv([lambda: Failing(with_observation(observation), at)]))
    model = CGP("MlpPolicy", env, **SMALL)
    with pytest.raises(ValueError, match=r"(NaN or infinite|wrong shape) .*at environment step 1[3-5]"):
        model.learn(300)
    assert model.replay_buffer.size() == at - 1
    if at == 15:
        # The statistics, which VecNormalize updates first, have not seen it
        assert model.learn(5, reset_num_timesteps=False).num_timesteps >= 19


class Repaired(VecEnvWrapper):
    """Replaces what is infinite, also in an episode's last observation."""

    def reset(self):
        return np.nan_to_num(self.venv.reset())

    def step_wait(self):
        observations, rewards, dones, infos = self.venv.step_wait()
        for info in infos:
            if "terminal_observation" in info:
                info["terminal_observation"] = np.nan_to_num(info["terminal_observation"], posinf=1.0)
        return np.nan_to_num(observations, posinf=1.0), rewards, dones, infos


@pytest.mark.parametrize("outer", [lambda env: env, VecNormalize], ids=["alone", "normalised"])
@pytest.mark.parametrize("at", [14, 15], ids=["within", "last"])
def test_observations_that_a_wrapper_repairs_are_trained_on(at, outer):
    env = outer(Repaired(DummyVecEnv([lambda: Failing(with_observation(np.full(3, np.inf)), at)])))
    assert CGP("MlpPolicy", env, **SMALL).learn(20).num_timesteps == 20


@pytest.mark.parametrize("normalised", [False, True])
def test_observations_out_of_bounds_are_warned_of_once(normalised):
    low = np.array([-5.0, -np.inf, -5.0])
    space = spaces.Box(low, -low, dtype=np.float64)
    outside = np.array([0.0, 99.0, -5.5])
    env = DummyVecEnv([lambda: Failing(observation_space=space), lambda: Failing(with_observation(outside), 8, space)])
    env.envs[1].observe = lambda: outside if env.envs[1].total >= 7 else np.zeros(3)
    model = CGP("MlpPolicy", VecNormalize(env) if normalised else env, **SMALL)
    with pytest.warns(UserWarning, match="outside of its observation space") as warned:
        model.learn(60)
    assert len(warned) == 1
    assert r"step 14: value -5.5 at index (2,), where the bounds are [-5.0, 5.0]" in str(warned[0].message)
    assert model.num_timesteps == 60


def test_normalised_images_are_not_out_of_bounds():
    """VecNormalize gives them a space of floats within ±clip_obs, which the images are not in before."""
    space = spaces.Box(0, 255, (3, 6, 6), np.uint8)
    env = VecNormalize(DummyVecEnv([lambda: Failing(with_observation(np.full((3, 6, 6), 200, np.uint8)), 3, space)]))
    env.venv.envs[0].observe = lambda: np.full((3, 6, 6), 200, np.uint8)
    model = CGP("MlpPolicy", env, **(SMALL | dict(policy_kwargs=dict(net_arch=[4], normalize_images=False))))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.learn(30)


def test_the_bounds_of_each_part_of_an_observation_are_watched():
    parts = {"position": spaces.Box(-1, 1, (2,)), "image": spaces.Box(0, 255, (2, 2), np.uint8), "free": UNBOUNDED}
    watch = BoundsWatch(spaces.Dict(parts))
    inside = {"position": np.ones((1, 2)), "image": np.zeros((1, 2, 2)), "free": np.full((1, 1), 1e9)}
    watch(Transition(3, spaces.Dict(parts), inside, None, [], 1))
    with pytest.warns(UserWarning, match=r"an observation `position` .* step 4: value 2.0 at index \(1,\)"):
        watch(Transition(4, spaces.Dict(parts), {**inside, "position": np.array([[0.0, 2.0]])}, None, [], 1))


def test_bounds_are_compared_in_the_data_type_of_the_space():
    box = spaces.Box(-0.7, 0.7, (1,), np.float32)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        BoundsWatch(box)(Transition(3, box, np.array([[0.7]]), None, [], 1))
    with pytest.warns(UserWarning, match="outside of its observation space"):
        BoundsWatch(box)(Transition(3, box, np.array([[0.71]]), None, [], 1))


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


def test_every_fault_in_the_documentation_has_its_test():
    section = (ROOT / "docs" / "trust.md").read_text().partition("## Faults\n")[2].partition("\n## ")[0]
    rows = [line for line in section.splitlines() if line.startswith("| ")][2:]
    assert len(rows) > 10
    for row in rows:
        named = re.findall(r"`tests/(test_\w+\.py)::(test_\w+)`", row.split(" | ")[-1])
        assert named, row
        for file, test in named:
            assert f"def {test}(" in (ROOT / "tests" / file).read_text(), test
