"""Signals that end a training whose states are saved, wherever it is, and what becomes of their handlers."""

import multiprocessing
import os
import signal
import threading
import time

import pytest
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from trainings import Do, make_model, parameters_equal

from sb3_cgp import CGP
from sb3_cgp.resumption import TrainingCheckpointCallback
from sb3_cgp.resumption.store import StateStore

pytestmark = pytest.mark.usefixtures("handler", "short_episodes")

SIGNALS = [(signal.SIGTERM, SystemExit, "143"), (signal.SIGINT, KeyboardInterrupt, "its state of step 40")]


def terminate():
    os.kill(os.getpid(), signal.SIGTERM)


@pytest.mark.parametrize("at", [1, 15, 33, 55], ids=["first step", "random steps", "within", "last step"])
def test_sigterm_ends_the_training_with_its_state_whenever_it_comes(at, tmp_path):
    callbacks = [TrainingCheckpointCallback(10, tmp_path), TrainingCheckpointCallback(10, tmp_path / "second")]
    with pytest.raises(SystemExit, match="143"):
        make_model().learn(55, [*callbacks, Do(at, terminate)])
    assert StateStore(tmp_path).load()[0] == at
    expected = make_model().learn(55)
    assert parameters_equal(CGP.resume(tmp_path, make_vec_env("Pendulum-v1")).learn(55), expected)


@pytest.mark.usefixtures("heeds_interruptions")
@pytest.mark.parametrize(("number", "error", "message"), SIGNALS)
def test_a_signal_ends_the_offline_training_of_a_policy(number, error, message, tmp_path, monkeypatch):
    monkeypatch.setattr("sb3_cgp.core.offline.ROUND", 10)
    stop = Do(55, lambda: os.kill(os.getpid(), number))
    with pytest.raises(error, match=message):
        make_model(policy_training="offline").learn(40, [TrainingCheckpointCallback(10, tmp_path), stop])
    resumed = CGP.resume(tmp_path, make_vec_env("Pendulum-v1"))
    assert not resumed._policy_is_trained
    assert resumed.num_timesteps == 40
    assert parameters_equal(resumed.learn(40), make_model(policy_training="offline").learn(40))


def test_a_resumed_offline_training_without_callbacks_is_saved_at_its_end(tmp_path, monkeypatch):
    monkeypatch.setattr("sb3_cgp.core.offline.ROUND", 10)
    with pytest.raises(SystemExit):
        make_model(policy_training="offline").learn(40, [TrainingCheckpointCallback(10, tmp_path), Do(45, terminate)])
    resumed = CGP.resume(tmp_path, make_vec_env("Pendulum-v1")).learn(40)
    finished = CGP.resume(tmp_path, make_vec_env("Pendulum-v1"))
    assert finished._policy_is_trained
    assert parameters_equal(finished, resumed)


@pytest.mark.parametrize("at", [20, 55], ids=["critics", "policy"])
def test_sigterm_during_an_evaluation(at, tmp_path, monkeypatch):
    monkeypatch.setattr("sb3_cgp.core.offline.ROUND", 10)

    def make(trains):
        env = make_vec_env("Pendulum-v1", seed=2)
        evaluation = EvalCallback(env, eval_freq=5, n_eval_episodes=1, verbose=0)
        if trains is False:
            # In the middle of the episode
            step, steps = env.step_wait, iter(range(1000))
            env.step_wait = lambda: (evaluation.n_calls == at and next(steps) == 9 and terminate()) or step()
        return evaluation

    stopped = make(False)
    with pytest.raises(SystemExit, match="143"):
        make_model(policy_training="offline").learn(40, [TrainingCheckpointCallback(10, tmp_path), stopped])
    assert StateStore(tmp_path).load()[0] == min(at, 40)
    straight, resumed = make(True), make(True)
    expected = make_model(policy_training="offline").learn(40, straight)
    model = CGP.resume(tmp_path, make_vec_env("Pendulum-v1"))
    assert parameters_equal(model.learn(40, [TrainingCheckpointCallback(10, tmp_path), resumed]), expected)
    assert (resumed.best_mean_reward, resumed.last_mean_reward) == (straight.best_mean_reward, straight.last_mean_reward)


@pytest.mark.usefixtures("heeds_interruptions")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_processes_forked_during_the_training_end_by_a_signal(number, tmp_path):
    ended = []
    context = multiprocessing.get_context("fork")
    is_running = context.Event()

    def run():
        is_running.set()
        time.sleep(60)

    def fork():
        process = context.Process(target=run)
        process.start()
        # Python forgets a signal that comes while it forks
        assert is_running.wait(30)
        os.kill(process.pid, number)
        process.join(30)
        ended.append(process.exitcode)
        process.kill()

    make_model().learn(30, [TrainingCheckpointCallback(10, tmp_path), Do(20, fork)])
    # multiprocessing reports the KeyboardInterrupt, and exits with 1
    assert ended == [-signal.SIGTERM if number == signal.SIGTERM else 1]


def test_a_signal_that_an_error_left_unanswered_reaches_the_handler_from_before(tmp_path, handler):
    seen = []

    def fail():
        terminate()
        raise ValueError("a simulator's")

    signal.signal(signal.SIGTERM, lambda *_: seen.append("before"))
    try:
        with pytest.raises(ValueError, match="a simulator's"):
            make_model().learn(50, [TrainingCheckpointCallback(10, tmp_path), Do(33, fail)])
    finally:
        signal.signal(signal.SIGTERM, handler)
    assert seen == ["before"]


@pytest.mark.parametrize("ends", [False, True], ids=["returns", "exits"])
@pytest.mark.parametrize("at", [33, 40, 45], ids=["within", "last step", "policy"])
@pytest.mark.parametrize("is_nested", [False, True], ids=["alone", "nested"])
def test_the_handler_from_before_is_called_once_when_the_state_is_saved(is_nested, at, ends, tmp_path, handler, monkeypatch):
    monkeypatch.setattr("sb3_cgp.core.offline.ROUND", 10)
    seen = []

    def handle(number, _):
        seen.append((number, StateStore(tmp_path / "state").load()[0]))
        if ends:
            raise SystemExit(7)

    def train():
        callbacks = [TrainingCheckpointCallback(10, tmp_path / "state"), Do(at, terminate)]
        make_model(policy_training="offline").learn(40, callbacks)

    outer = [TrainingCheckpointCallback(10, tmp_path / "outer"), Do(15, train)]
    signal.signal(signal.SIGTERM, handle)
    try:
        with pytest.raises(SystemExit, match="7" if ends else "143"):
            make_model().learn(30, outer) if is_nested else train()
    finally:
        signal.signal(signal.SIGTERM, handler)
    # A training within a callback has ended
    assert seen == [(signal.SIGTERM, 40 if is_nested else min(at, 40))]


def test_a_second_sigterm_acts_as_before(tmp_path, handler):
    seen = []
    reach = Do(33, lambda: seen.append(33))
    signal.signal(signal.SIGTERM, lambda *_: seen.append("before"))
    try:
        with pytest.raises(SystemExit, match="143"):
            make_model().learn(50, [TrainingCheckpointCallback(10, tmp_path), Do(33, terminate), Do(33, terminate), reach])
        # Each of the two, the second one at once
        assert seen == ["before", 33, "before"]
    finally:
        signal.signal(signal.SIGTERM, handler)


@pytest.mark.usefixtures("heeds_interruptions")
def test_a_second_ctrl_c_stops_at_once(tmp_path):
    press, seen = (lambda: signal.raise_signal(signal.SIGINT)), []
    callbacks = [TrainingCheckpointCallback(10, tmp_path), Do(33, press), Do(33, press), Do(33, lambda: seen.append(33))]
    with pytest.raises(KeyboardInterrupt, match=r"^$"):
        make_model().learn(50, callbacks)
    assert (seen, StateStore(tmp_path).load()[0]) == ([], 30)


@pytest.mark.usefixtures("heeds_interruptions")
@pytest.mark.parametrize(("number", "error", "message"), SIGNALS)
def test_a_signal_in_the_last_step_ends_the_offline_training_that_follows(number, error, message, tmp_path):
    press = Do(40, lambda: os.kill(os.getpid(), number))
    steps = []
    count = Do(41, lambda: steps.append(41))
    with pytest.raises(error, match=message):
        make_model(policy_training="offline").learn(40, [TrainingCheckpointCallback(10, tmp_path), press, count])
    assert steps == []


@pytest.mark.usefixtures("heeds_interruptions")
@pytest.mark.parametrize("has_learnt_in_it", [True, False])
def test_an_interrupted_train_policy_says_that_it_is_to_be_called_again(has_learnt_in_it, tmp_path, monkeypatch):
    monkeypatch.setattr("sb3_cgp.core.offline.ROUND", 10)
    checkpoint = TrainingCheckpointCallback(10, tmp_path)
    model = make_model().learn(30, checkpoint if has_learnt_in_it else None)
    press = Do(5, lambda: signal.raise_signal(signal.SIGINT))
    with pytest.raises(KeyboardInterrupt, match="`train_policy` saves no state before its end; call it again"):
        model.train_policy(60, callback=[checkpoint, press])
    assert StateStore(tmp_path).steps() == ([20, 30] if has_learnt_in_it else [])
    assert model.train_policy(20, callback=checkpoint)._policy_is_trained
    assert StateStore(tmp_path).load()[0] == 30


@pytest.mark.usefixtures("heeds_interruptions")
@pytest.mark.parametrize(("number", "error", "message"), SIGNALS)
@pytest.mark.parametrize("at", [0, 15], ids=["before it", "within it"])
@pytest.mark.parametrize("saves", [True, False], ids=["states", "no states"])
def test_a_training_within_a_callback_ends_and_then_the_outer_one_by_its_signal(saves, at, number, error, message, tmp_path):
    press, inner, seen = (lambda: os.kill(os.getpid(), number)), make_model(seed=1), []
    callbacks = [Do(at, press), *([TrainingCheckpointCallback(10, tmp_path / "inner")] if saves else [])]

    def train():
        if at == 0:
            press()
        inner.learn(30, callbacks)

    outer = [TrainingCheckpointCallback(10, tmp_path / "outer"), Do(44, train), Do(45, lambda: seen.append(45))]
    with pytest.raises(error, match=message.replace("40", "44")):
        make_model().learn(60, outer)
    assert (inner.num_timesteps, seen, StateStore(tmp_path / "outer").load()[0]) == (30, [], 44)
    if saves:
        assert StateStore(tmp_path / "inner").load()[0] == 30
    # Neither training is left behind
    again = [TrainingCheckpointCallback(10, tmp_path / "again"), Do(5, press)]
    with pytest.raises(error):
        make_model().learn(60, again)
    assert StateStore(tmp_path / "again").load()[0] == 5


@pytest.mark.usefixtures("heeds_interruptions")
@pytest.mark.parametrize(("number", "error", "message"), SIGNALS)
def test_a_training_within_a_callback_of_one_without_states_saves_and_ends_both(number, error, message, tmp_path):
    inner = [TrainingCheckpointCallback(10, tmp_path), Do(40, lambda: os.kill(os.getpid(), number))]
    train = Do(15, lambda: make_model(seed=1).learn(60, inner))
    model = make_model()
    with pytest.raises(error, match=message):
        model.learn(60, train)
    assert (model.num_timesteps, StateStore(tmp_path).load()[0]) == (15, 40)


@pytest.mark.usefixtures("heeds_interruptions")
@pytest.mark.parametrize("first_at", [0, 15], ids=["first before it", "both within it"])
def test_a_second_ctrl_c_stops_an_inner_training_at_once(first_at, tmp_path):
    press, seen = (lambda: signal.raise_signal(signal.SIGINT)), []
    inner = [TrainingCheckpointCallback(10, tmp_path / "inner"), Do(first_at, press), Do(15, press)]

    def train():
        if first_at == 0:
            press()
        make_model(seed=1).learn(60, [*inner, Do(15, lambda: seen.append(15))])

    with pytest.raises(KeyboardInterrupt, match=r"^$"):
        make_model().learn(60, [TrainingCheckpointCallback(10, tmp_path / "outer"), Do(44, train)])
    assert (seen, StateStore(tmp_path / "inner").load()[0], StateStore(tmp_path / "outer").load()[0]) == ([], 10, 40)


@pytest.mark.usefixtures("heeds_interruptions")
def test_a_training_in_another_thread_does_not_end_by_the_signal_of_the_main_ones(tmp_path):
    steps = []

    def train():
        thread = threading.Thread(target=lambda: steps.append(make_model(seed=1).learn(30).num_timesteps))
        signal.raise_signal(signal.SIGINT)
        thread.start()
        thread.join()

    with pytest.raises(KeyboardInterrupt):
        make_model().learn(60, [TrainingCheckpointCallback(10, tmp_path), Do(44, train)])
    assert (steps, StateStore(tmp_path).load()[0]) == ([30], 44)


@pytest.mark.usefixtures("heeds_interruptions")
@pytest.mark.parametrize("is_ignored", [True, False])
def test_ctrl_c_that_is_ignored_or_handled_by_others_stays_so(is_ignored, tmp_path):
    seen = []
    signal.signal(signal.SIGINT, signal.SIG_IGN if is_ignored else lambda *_: seen.append("theirs"))
    press = Do(33, lambda: signal.raise_signal(signal.SIGINT))
    assert make_model().learn(50, [TrainingCheckpointCallback(10, tmp_path), press]).num_timesteps == 50
    assert seen == ([] if is_ignored else ["theirs"])


@pytest.mark.usefixtures("heeds_interruptions")
@pytest.mark.parametrize("at", [33, 55], ids=["within", "last step"])
def test_several_callbacks_save_before_a_signal_ends_the_training(at, tmp_path):
    ended, folders = [], [tmp_path / "one", tmp_path / "other"]
    stop = Do(at, lambda: signal.raise_signal(signal.SIGINT))
    stop._on_training_end = lambda: ended.append(True)
    with pytest.raises(KeyboardInterrupt, match=f"its state of step {at} is in .*one"):
        make_model().learn(55, [*(TrainingCheckpointCallback(100, folder) for folder in folders), stop])
    assert [StateStore(folder).load()[0] for folder in folders] == [at, at]
    assert ended == [True] * (at == 55)


@pytest.mark.usefixtures("heeds_interruptions")
def test_a_handler_that_a_callback_sets_is_kept(tmp_path, handler):
    theirs = lambda *_: None  # noqa: E731
    make_model().learn(30, [TrainingCheckpointCallback(10, tmp_path), Do(20, lambda: signal.signal(signal.SIGTERM, theirs))])
    assert signal.getsignal(signal.SIGTERM) is theirs
    signal.signal(signal.SIGTERM, handler)


def test_in_another_thread_states_are_saved_and_signals_left_alone(tmp_path):
    thread = threading.Thread(target=lambda: make_model().learn(30, TrainingCheckpointCallback(10, tmp_path)))
    thread.start()
    thread.join()
    assert StateStore(tmp_path).load()[0] == 30
