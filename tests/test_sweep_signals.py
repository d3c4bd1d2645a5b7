"""Signals that ask a sweep's processes to end, also where Python drops the exceptions of their handlers."""

import signal
import weakref
from functools import partial
from types import SimpleNamespace

import optuna
import pytest
from ledgers import trials_of
from optuna.storages import InMemoryStorage
from optuna.trial import TrialState
from stable_baselines3.common.env_util import make_vec_env
from studies import make_sweep, pretend_to_train, work_through
from trainings import SMALL, Do
from tunings import arguments, tuner_of

from benchmark import sweep, tune
from benchmark.sweeps import execution, groups, signals, tune_execution
from benchmark.sweeps import worker_loop as worker
from benchmark.sweeps.heartbeats import TrialLostError
from benchmark.sweeps.storages import open_storage
from benchmark.sweeps.studies import Ledger
from sb3_cgp import CGP
from sb3_cgp.resumption import TrainingCheckpointCallback
from sb3_cgp.resumption.store import StateStore

pytestmark = [
    pytest.mark.usefixtures("heeds_interruptions", "_unasked"),
    # Those that are raised where they are dropped
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]


@pytest.fixture
def _unasked(monkeypatch):
    """A process that no signal has asked to end."""
    monkeypatch.setattr(signals, "_noted", [])


class Object:
    pass


def lose(number):
    """Raise a signal where Python drops its handler's exception."""
    thing = Object()
    reference = weakref.ref(thing, lambda _: signal.raise_signal(number))
    del thing
    assert reference() is None


class Finalizer:
    def __init__(self, number):
        self.number = number

    def __del__(self):
        signal.raise_signal(self.number)


def lose_in_finalizer(number):
    Finalizer(number)


HANDLERS = [
    (signals.handle_as_command, signal.SIGTERM, SystemExit),
    (signals.handle_as_command, signal.SIGINT, KeyboardInterrupt),
    (lambda: signals.handle_as_worker(1), signal.SIGTERM, SystemExit),
    (lambda: signals.handle_as_worker(None), signal.SIGTERM, SystemExit),
    (lambda: signals.handle_as_worker(None), signal.SIGINT, SystemExit),
]


@pytest.mark.parametrize("drop", [lose, lose_in_finalizer])
@pytest.mark.parametrize(("handle", "number", "error"), HANDLERS)
def test_a_signal_whose_exception_is_dropped_is_heeded_later(handle, number, error, drop):
    handle()
    signals.end_if_asked()
    drop(number)
    with pytest.raises(error) as end:
        signals.end_if_asked()
    assert error is KeyboardInterrupt or end.value.code == 143


@pytest.mark.parametrize(("handle", "number", "error"), HANDLERS)
def test_a_signal_ends_the_process_at_once_and_a_second_sigterm_does_not_interrupt_that(handle, number, error):
    handle()
    with pytest.raises(error):
        signal.raise_signal(number)
    signal.raise_signal(signal.SIGTERM)
    signal.raise_signal(signal.SIGTERM)


@pytest.mark.parametrize(
    ("handle", "error"), [(signals.handle_as_command, KeyboardInterrupt), (lambda: signals.handle_as_worker(None), SystemExit)]
)
def test_ctrl_c_interrupts_each_time(handle, error):
    handle()
    with pytest.raises(SystemExit):
        signal.raise_signal(signal.SIGTERM)
    for _ in range(2):
        with pytest.raises(error):
            signal.raise_signal(signal.SIGINT)


def test_ctrl_c_is_the_parents_and_that_of_a_command_in_the_background_is_ignored():
    signals.handle_as_worker(1)
    signal.raise_signal(signal.SIGINT)
    for handle in (signals.handle_as_command, lambda: signals.handle_as_worker(None)):
        handle()
        signal.raise_signal(signal.SIGINT)
    signals.end_if_asked()


@pytest.mark.parametrize(
    ("parent", "number", "saved"), [(1, signal.SIGTERM, True), (None, signal.SIGTERM, True), (None, signal.SIGINT, False)]
)
def test_a_second_sigterm_does_not_keep_a_training_from_saving_but_a_second_ctrl_c_does(tmp_path, parent, number, saved):
    """A scheduler sends SIGTERM to all processes of a job, and the parent once more to its own."""
    signals.handle_as_worker(parent)
    model = CGP("MlpPolicy", make_vec_env("Pendulum-v1", seed=1), **SMALL | dict(policy_kwargs=dict(net_arch=[8])))
    asking = [Do(33, lambda: signal.raise_signal(number)) for _ in range(2)]
    with pytest.raises(SystemExit, match="143"):
        model.learn(50, [TrainingCheckpointCallback(20, tmp_path), *asking])
    assert (StateStore(tmp_path).load()[0] >= 33) == saved


@pytest.mark.parametrize(("when", "ended"), [("before", []), ("during", []), ("after", [0])])
def test_a_worker_that_lost_a_signal_gives_its_run_back_and_takes_no_other(clock, tmp_path, monkeypatch, when, ended):
    """... at the run's next step; a signal after the last one comes too late for that."""
    signals.handle_as_worker(1)

    class Heart:
        def __init__(self, *_):
            pass

        def __enter__(self):
            return self

        def __exit__(self, *exception):
            pass

        watch = staticmethod(lambda step: signals.end_if_asked())

    def train(run, folder, report, watch, device):
        def act(step):
            if when == "during" and step == 50:
                lose(signal.SIGTERM)
            watch(step)

        if when == "before":
            lose(signal.SIGTERM)
        value = pretend_to_train(run, folder, report, act, device)
        if when == "after":
            lose(signal.SIGTERM)
        return value

    monkeypatch.setattr(worker, "HeartbeatThread", Heart)
    monkeypatch.setattr(worker, "train", train)
    storage = InMemoryStorage()
    with pytest.raises(SystemExit, match="143"):
        work_through(storage, make_sweep(["Good"]), clock, tmp_path)
    states = [trial.state for trial in trials_of(storage)]
    assert [value for trial in trials_of(storage) for value in trial.values or []] == ended
    assert TrialState.RUNNING not in states
    assert states.count(TrialState.WAITING) == 2 - len(ended)


def learn(folder, function):
    """Train with states, and call a function at step 33."""
    model = CGP("MlpPolicy", make_vec_env("Pendulum-v1", seed=1), **SMALL | dict(policy_kwargs=dict(net_arch=[8])))
    model.learn(50, [TrainingCheckpointCallback(20, folder), Do(33, function)])


def test_a_run_that_fails_after_a_signal_is_given_back(clock, tmp_path, monkeypatch):
    """The signal may have ended a simulator, too."""

    def fail():
        signal.raise_signal(signal.SIGTERM)
        raise ValueError("a simulator's")

    signals.handle_as_worker(1)
    monkeypatch.setattr(worker, "train", lambda run, folder, *_: learn(folder / "state", fail))
    storage = InMemoryStorage()
    with pytest.raises(SystemExit, match="143"):
        work_through(storage, make_sweep(["Good"]), clock, tmp_path)
    trials = trials_of(storage)
    assert [trial.user_attrs["error"] for trial in trials if "error" in trial.user_attrs] == []
    assert [trial.state for trial in trials].count(TrialState.WAITING) == 2


def once(method):
    """Let a second signal arrive after the first call of a method."""
    calls = iter([lambda: signal.raise_signal(signal.SIGTERM)])

    def act(*args, **kwargs):
        result = method(*args, **kwargs)
        next(calls, lambda: None)()
        return result

    return act


CLAIMING = [(Ledger, "_take"), (Ledger, "annotate"), (groups.Groups, "claim"), (worker, "run_folder"), (worker, "ClaimedRuns")]


@pytest.mark.parametrize(("owner", "name"), CLAIMING)
def test_a_signal_while_runs_are_taken_gives_them_back(clock, tmp_path, monkeypatch, owner, name):
    """Also where it comes between two writes to the study, or between the claim and the training."""
    signals.handle_as_worker(1)
    monkeypatch.setattr(owner, name, once(getattr(owner, name)))
    trained = []
    monkeypatch.setattr(worker, "train", lambda *args: trained.append(args))
    storage = InMemoryStorage()
    with pytest.raises(SystemExit, match="143"):
        work_through(storage, make_sweep(["Good"]), clock, tmp_path)
    assert trained == []
    assert [trial.state for trial in trials_of(storage)] == [TrialState.FAIL, TrialState.WAITING, TrialState.WAITING]


@pytest.mark.parametrize("error", [ValueError("the run's"), TrialLostError("the trial")])
def test_a_signal_while_a_run_is_given_up_does_not_interrupt_that(clock, tmp_path, monkeypatch, error):
    signals.handle_as_worker(1)

    def fail(*args):
        monkeypatch.setattr(Ledger, "_end", once(Ledger._end))
        raise error

    monkeypatch.setattr(worker, "train", fail)
    storage = InMemoryStorage()
    with pytest.raises(SystemExit, match="143"):
        work_through(storage, make_sweep(["Good"]), clock, tmp_path)
    trials = trials_of(storage)
    failed = "error" in trials[0].user_attrs
    assert failed == isinstance(error, ValueError)
    assert [trial.state for trial in trials] == [TrialState.FAIL, TrialState.WAITING] + [TrialState.WAITING] * (not failed)


def test_a_signal_while_a_configuration_is_taken_gives_it_back(work, pretend, monkeypatch):
    signals.handle_as_worker(1)
    storage = InMemoryStorage()
    runs = pretend(lambda run: 1.0)
    monkeypatch.setattr(optuna.Study, "ask", once(optuna.Study.ask))
    with pytest.raises(SystemExit, match="143"):
        work(storage=storage, trials=1, seeds=1)
    assert runs == []
    # Of a new configuration nothing had been sampled
    assert [trial.state for trial in storage.get_all_trials(0)] == [TrialState.FAIL]


def test_a_signal_does_not_lose_a_configuration_that_is_enqueued_again(monkeypatch):
    signals.handle_as_worker(1)
    storage = InMemoryStorage()
    tuner = tuner_of(tune.parse(arguments()), storage)
    trial = tuner._study.ask()
    tuner._tuning.sample(trial)
    monkeypatch.setattr(tuner._silence, "find", lambda trials: trials)
    monkeypatch.setattr(storage, "set_trial_state_values", once(storage.set_trial_state_values))
    tuner.recover()
    assert [trial.state for trial in tuner.trials()] == [TrialState.FAIL, TrialState.WAITING]
    with pytest.raises(SystemExit, match="143"):
        signals.end_if_asked()


def test_a_second_signal_does_not_interrupt_the_giving_back_of_a_run(clock, tmp_path, monkeypatch):
    signals.handle_as_worker(1)
    ask = partial(signal.raise_signal, signal.SIGTERM)
    monkeypatch.setattr(worker, "train", lambda run, folder, *_: learn(folder / "state", ask))
    monkeypatch.setattr(Ledger, "_end", once(Ledger._end))
    storage = InMemoryStorage()
    with pytest.raises(SystemExit, match="143"):
        work_through(storage, make_sweep(["Good"]), clock, tmp_path)
    assert [trial.state for trial in trials_of(storage)].count(TrialState.WAITING) == 2


def test_a_second_signal_does_not_interrupt_the_giving_back_of_a_configuration(work, pretend, tmp_path, monkeypatch):
    signals.handle_as_worker(1)
    storage = InMemoryStorage()
    pretend(lambda run: learn(tmp_path, partial(signal.raise_signal, signal.SIGTERM)))
    monkeypatch.setattr(storage, "set_trial_state_values", once(storage.set_trial_state_values))
    with pytest.raises(SystemExit, match="143"):
        work(storage=storage, trials=1)
    assert [trial.state for trial in storage.get_all_trials(0)] == [TrialState.FAIL, TrialState.WAITING]


def test_a_process_that_tunes_and_lost_a_signal_takes_no_other_trial(work, pretend):
    signals.handle_as_worker(1)
    storage = InMemoryStorage()
    runs = pretend(lambda run: lose(signal.SIGTERM) or 1.0)
    with pytest.raises(SystemExit, match="143"):
        work(storage=storage, trials=2, seeds=1)
    assert len(runs) == 1


class Process:
    """A process that trains until it is asked to end."""

    def __init__(self):
        self.signals = []

    def poll(self):
        return -self.signals[0] if self.signals else None

    send_signal = property(lambda self: self.signals.append)

    def wait(self):
        assert self.signals


def start(command, folder):
    """Do what a command does with its arguments."""
    if command == "tune":
        args = tune.parse(arguments("--logs", str(folder)))
        tune_execution.tune(tuner_of(args, InMemoryStorage()), "study", args, [])
    else:
        url = f"sqlite:///{folder}/studies.db"
        argv = ["e1", "--task", "Pendulum-v1", "--storage", url, "--logs", str(folder), "--results", str(folder)]
        args = sweep.parse(argv)
        execution.execute(sweep.load("e1", args), open_storage(url), "study", args, argv)


@pytest.mark.parametrize(("number", "error"), [(signal.SIGTERM, SystemExit), (signal.SIGINT, KeyboardInterrupt)])
@pytest.mark.parametrize("command", ["sweep", "tune"])
def test_a_command_that_lost_a_signal_ends_its_processes(tmp_path, monkeypatch, capsys, command, number, error):
    signals.handle_as_command()
    process = Process()
    module = execution if command == "sweep" else tune_execution
    monkeypatch.setattr(module, "start_workers", lambda *_: [process])
    sleeps = iter([lambda: lose(number)])
    # A second one is an error
    monkeypatch.setattr(module, "time", SimpleNamespace(sleep=lambda _: next(sleeps)()))
    with pytest.raises(error):
        start(command, tmp_path)
    assert process.signals == [signal.SIGTERM]
    assert "The same command continues." in capsys.readouterr().err
