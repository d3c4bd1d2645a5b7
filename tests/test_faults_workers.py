"""What happens when a worker process of a SubprocVecEnv fails."""

import os
import signal
import time

import pytest
from faulty_environments import SMALL, Failing, assert_buried, raise_error, subproc
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.vec_env import SubprocVecEnv, VecNormalize
from trainings import Do

from sb3_cgp import CGP


def kill_worker(*_):
    os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(60)


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
