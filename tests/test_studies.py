"""A sweep's ledger: no run is skipped and none counts twice, whatever dies between which two steps."""

import os
import random
import signal
import socket
import subprocess
import sys
import time

import pytest
import torch as th
from gymnasium.error import DependencyNotInstalled
from optuna.exceptions import StorageInternalError
from optuna.storages import InMemoryStorage, RDBStorage
from optuna.trial import TrialState
from studies import GRACE, Clock, Crew, assert_each_run_once, make_sweep, mortal, pretend_to_train, work_through

import benchmark.worker
from benchmark.sweeps import worker_loop as worker
from benchmark.sweeps.heartbeats import PROGRESS, TrialLostError
from benchmark.sweeps.storages import open_storage, patiently
from benchmark.sweeps.studies import Ledger
from benchmark.sweeps.study_trials import ERROR, KEY, OUTCOME, WORKER, distributions_of, with_seed
from benchmark.sweeps.validation import SweepError
from benchmark.sweeps.worker_loop import execute_runs


@pytest.fixture
def ledger():
    """Of three runs: seeds 0 to 2."""
    return open_ledger(InMemoryStorage(), Clock())


def open_ledger(storage, clock, **sweep):
    ledger = Ledger(storage, "study", GRACE, clock)
    ledger.open(make_sweep(**({"methods": ["Good"], "seeds": 3} | sweep)), {"experiment": "tiny"})
    return ledger


def another(ledger, clock=None):
    """A ledger of another process."""
    return Ledger(ledger.storage, ledger.name, GRACE, clock or ledger._silence._clock)


def look_for(ledger, seconds):
    """Let a process look again and again, and the time pass."""
    for _ in range(round(seconds / 5)):
        ledger.recover()
        ledger._silence._clock.sleep(5)
    ledger.recover()


def trials_of(storage):
    return storage.get_all_trials(storage.get_study_id_from_name("study"))


@pytest.mark.parametrize("takes_effect", [False, True])
def test_a_process_may_die_at_any_call(clock, tmp_path, takes_effect):
    sweep = make_sweep()
    calls = 0
    while True:
        storage = InMemoryStorage()
        has_died = mortal(storage, sweep, clock, tmp_path, calls, takes_effect)
        work_through(storage, sweep, clock, tmp_path)
        assert_each_run_once(trials_of(storage), sweep)
        if not has_died:
            break
        calls += 1
    # It died at each of the calls that a study takes
    assert calls > 40


def test_processes_may_die_one_after_another(clock, tmp_path):
    draw = random.Random(0)
    sweep = make_sweep()
    for _ in range(60):
        storage = InMemoryStorage()
        for _ in range(draw.randint(2, 12)):
            mortal(storage, sweep, clock, tmp_path, draw.randint(0, 40), draw.random() < 0.5)
        work_through(storage, sweep, clock, tmp_path)
        assert_each_run_once(trials_of(storage), sweep)


@pytest.mark.parametrize("seed", range(60))
def test_processes_side_by_side_may_die_lose_answers_and_be_away(clock, tmp_path, seed):
    sweep = make_sweep(seeds=3)
    storage = InMemoryStorage()
    Crew(seed, storage, clock).work(sweep, tmp_path, n_processes=3, n_deaths=seed % 8, n_steps=20_000)
    assert_each_run_once(trials_of(storage), sweep)


def test_each_run_is_claimed_once_by_several_real_processes(monkeypatch, tmp_path):
    sweep = make_sweep(seeds=5)
    url = f"sqlite:///{tmp_path}/studies.db"
    claimed = tmp_path / "claimed"

    def train(run, *args):
        with open(claimed, "a") as file:
            file.write(f"{run.key}\n")
        return pretend_to_train(run, *args)

    monkeypatch.setattr(worker, "train", train)
    monkeypatch.setattr(worker, "PAUSE", 0.1)
    children = [forked(lambda: work_through(open_storage(url), sweep, time.monotonic, tmp_path)) for _ in range(4)]
    assert [os.waitpid(child, 0)[1] for child in children] == [0] * 4
    assert sorted(claimed.read_text().splitlines()) == sorted(run.key for run in sweep.runs())
    assert_each_run_once(trials_of(open_storage(url)), sweep)


def forked(act):
    child = os.fork()
    if child == 0:
        status = 1
        try:
            act()
            status = 0
        finally:
            os._exit(status)
    return child


def test_a_silent_process_is_given_up_after_the_grace(ledger):
    clock = ledger._silence._clock
    claim = ledger.claim("silent")
    ledger.beat(claim, "1-0", 10, 1.0)
    other = another(ledger)
    look_for(other, GRACE)
    ledger.beat(claim, "1-1", 20, 2.0)
    look_for(other, GRACE)
    # Its silence has lasted for the grace, and not for longer
    assert ledger.trials()[0].state is TrialState.RUNNING
    clock.sleep(1)
    other.recover()
    lost, *_, successor = ledger.trials()
    assert (lost.state, lost.user_attrs[OUTCOME]) == (TrialState.FAIL, "lost: its process fell silent")
    assert ERROR not in lost.user_attrs
    assert (successor.state, successor.user_attrs[KEY]) == (TrialState.WAITING, lost.user_attrs[KEY])
    other.recover()
    assert len(ledger.trials()) == 4


def test_who_was_away_gives_nobody_up(ledger):
    """While the database was away, nobody could be heard."""
    claim = ledger.claim("alive")
    ledger.beat(claim, "1-0", 10, 1.0)
    other = another(ledger)
    look_for(other, 10)
    for _ in range(3):
        other._silence._clock.sleep(2 * GRACE)
        other.recover()
        assert ledger.trials()[0].state is TrialState.RUNNING
    look_for(other, GRACE + 5)
    assert ledger.trials()[0].state is TrialState.FAIL


def test_a_process_that_never_beat_is_given_up(ledger):
    ledger.claim("stillborn")
    look_for(ledger, GRACE + 5)
    assert ledger.trials()[0].state is TrialState.FAIL


def test_a_run_that_is_lost_again_and_again_has_one_open_trial(ledger):
    key = ledger.trials()[0].user_attrs[KEY]
    for _ in range(5):
        while (claim := ledger.claim("mortal")) is not None and claim.run.key != key:
            ledger.complete(claim, 0.0)
        look_for(ledger, GRACE + 5)
        own = [trial for trial in ledger.trials() if trial.user_attrs[KEY] == key]
        assert [trial.state for trial in own if trial.state is not TrialState.FAIL] == [TrialState.WAITING]


def test_a_process_that_comes_back_has_lost_its_trial(ledger):
    claim = ledger.claim("paused")
    look_for(another(ledger), GRACE + 5)
    with pytest.raises(TrialLostError, match="trial 0"):
        ledger.beat(claim, "1-0", 0, 0.0)
    with pytest.raises(TrialLostError):
        ledger.report(claim, 10, 1.0)
    with pytest.raises(TrialLostError):
        ledger.complete(claim, 1.0)
    ledger.fail(claim, ValueError("too late"))
    ledger.release(claim)
    lost, *others = ledger.trials()
    assert lost.intermediate_values == {}
    assert ERROR not in lost.user_attrs
    assert [trial.state for trial in others] == [TrialState.WAITING] * 3


def test_a_failure_is_recorded_with_its_error_and_its_curve(ledger):
    claim = ledger.claim("one")
    ledger.beat(claim, "1-0", 20, 3.0)
    ledger.report(claim, 10, 1.5)
    ledger.report(claim, 20, float("nan"))
    ledger.fail(claim, FloatingPointError("NaN in the critic"))
    ledger.recover()
    assert len(ledger.trials()) == 3
    (record,) = ledger.records()
    assert (record.method, record.seed, record.final, record.seconds) == ("Good", 0, None, 3.0)
    assert record.error == "FloatingPointError: NaN in the critic"
    assert record.timesteps == [10, 20]
    assert record.returns[0] == 1.5


def test_a_failure_stands_although_its_process_died_before_it_ended_the_trial(ledger):
    claim = ledger.claim("one")
    ledger.storage.set_trial_user_attr(claim.trial_id, ERROR, "ValueError: its own fault")
    look_for(ledger, GRACE + 5)
    assert [record.error for record in ledger.records()] == ["ValueError: its own fault"]
    assert len(ledger.trials()) == 3


def test_a_run_that_is_given_back_is_taken_up_again(ledger):
    first = ledger.claim("one")
    ledger.beat(first, "1-0", 50, 7.0)
    ledger.release(first)
    keys = []
    while (claim := ledger.claim("two")) is not None:
        ledger.beat(claim, "2-0", 100, 5.0)
        ledger.complete(claim, 1.0)
        keys.append(claim.run.key)
    assert sorted(keys) == sorted({trial.user_attrs[KEY] for trial in ledger.trials()})
    assert ledger.left() == []
    assert {record.seed: record.seconds for record in ledger.records()} == {0: 12.0, 1: 5.0, 2: 5.0}


def test_a_run_between_two_trials_is_left(ledger):
    """All trials have ended, but a run has none: its process was stopped in between."""
    claim = ledger.claim("one")
    while (rest := ledger.claim("one")) is not None:
        ledger.complete(rest, 1.0)
    ledger.storage.set_trial_state_values(claim.trial_id, TrialState.FAIL)
    assert all(trial.state.is_finished() for trial in ledger.trials())
    assert ledger.left() == [claim.run.key]


def test_a_study_is_not_opened_with_other_settings(ledger):
    with pytest.raises(SweepError, match=r"'study': steps: was 100 and is now 200 for Good.*--study"):
        open_ledger(ledger.storage, Clock(), steps=200)
    with pytest.raises(SweepError, match=r"'study': has other methods, tasks or axes.*--study"):
        open_ledger(ledger.storage, Clock(), tasks=["Reacher-v5"])
    assert len(ledger.trials()) == 3
    assert {trial.user_attrs["run"]["steps"] for trial in ledger.trials()} == {100}


def test_a_study_may_get_more_seeds_and_more_of_its_methods(ledger):
    open_ledger(ledger.storage, Clock())
    assert len(ledger.trials()) == 3
    open_ledger(ledger.storage, Clock(), seeds=5)
    assert [trial.user_attrs["run"]["seed"] for trial in ledger.trials()] == [0, 1, 2, 3, 4]
    open_ledger(ledger.storage, Clock(), methods=["Other"], seeds=[7])
    assert ledger.trials()[-1].user_attrs[KEY] == "Other,Pendulum-v1,seed=7"


def test_a_trial_shows_its_name_and_its_seed_and_the_seed_is_no_parameter(ledger):
    """optuna-dashboard shows attributes as columns, sorts by numbers, and takes parameters alone for its importances."""
    assert [set(trial.params) for trial in ledger.trials()] == [{"method", "task"}] * 3
    assert [trial.user_attrs["seed"] for trial in ledger.trials()] == [0, 1, 2]
    assert ledger.trials()[0].user_attrs[KEY] == "Good,Pendulum-v1,seed=0"


def test_a_study_of_an_earlier_version_goes_on_with_the_seed_as_a_parameter(monkeypatch):
    storage = InMemoryStorage()
    with monkeypatch.context() as patch:
        patch.setattr("benchmark.sweeps.studies.distributions_of", lambda sweep: with_seed(distributions_of(sweep)))
        first = open_ledger(storage, Clock())
    assert [trial.params["seed"] for trial in first.trials()] == [0, 1, 2]
    claim = first.claim("worker")
    first.release(claim)
    later = open_ledger(storage, Clock(), seeds=4)
    assert [trial.params["seed"] for trial in later.trials()] == [0, 1, 2, 0, 3]
    assert len({str(trial.distributions) for trial in later.trials()}) == 1
    with pytest.raises(SweepError, match="has other methods, tasks or axes"):
        open_ledger(storage, Clock(), tasks=["Reacher-v5"])


def test_hyperparameters_that_json_changes_are_the_same(ledger):
    sweep = dict(hyperparams={"policy_kwargs": {1: (2, 3)}}, seeds=1)
    storage = InMemoryStorage()
    open_ledger(storage, Clock(), **sweep)
    rdb = RDBStorage("sqlite:///:memory:")
    open_ledger(rdb, Clock(), **sweep)
    open_ledger(rdb, Clock(), **sweep)
    assert len(trials_of(rdb)) == 1


def test_trials_of_others_are_left_alone(ledger):
    ledger.storage.create_new_trial(ledger.study_id)
    assert len(ledger.trials()) == 3
    look_for(ledger, GRACE + 5)
    assert trials_of(ledger.storage)[-1].state is TrialState.RUNNING


@pytest.mark.parametrize("error", [StorageInternalError, ConnectionError])
def test_patience_with_a_database_that_is_away(clock, error):
    answers = iter([error("away")] * 6)

    def call(argument):
        answer = next(answers, None)
        if answer is not None:
            raise answer
        return argument

    assert patiently(call, "there") == "there"
    # Twice as long each time, up to five seconds
    assert clock.now == pytest.approx(0.1 + 0.2 + 0.4 + 0.8 + 1.6 + 3.2)


def test_patience_has_an_end(clock):
    def call():
        raise StorageInternalError("away")

    with pytest.raises(StorageInternalError):
        patiently(call, patience=20.0)
    assert 10 < clock.now <= 20


def test_no_patience_with_other_errors(clock):
    def call():
        raise KeyError("no such study")

    with pytest.raises(KeyError):
        patiently(call)
    assert clock.now == 0


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("grpc://localhost", "must have a host and a port"),
        ("studies.db", "must be a database's URL"),
        ("nosuchdatabase://localhost/x", "must be a database's URL"),
        ("sqlite://", "in the memory of one process, but must be one that other processes reach, such as sqlite:///"),
        ("sqlite:///", "in the memory of one process"),
        ("sqlite:///:memory:", "in the memory of one process"),
        ("sqlite+pysqlite:///:memory:", "in the memory of one process"),
        ("sqlite:///file::memory:?cache=shared&uri=true", "in the memory of one process"),
        ("sqlite:///file:mine?mode=memory&uri=true", "in the memory of one process"),
    ],
)
def test_a_storage_that_is_none(url, message):
    with pytest.raises(ValueError, match=message):
        open_storage(url)


@pytest.mark.parametrize(
    "error",
    [OSError("disk"), ImportError("no Box2D"), DependencyNotInstalled("no Box2D"), MemoryError(), th.OutOfMemoryError("GPU")],
)
def test_what_the_machine_lacks_is_no_fault_of_the_run(ledger, monkeypatch, tmp_path, error):
    def train(*args):
        raise error

    monkeypatch.setattr(worker, "train", train)
    with pytest.raises(type(error)):
        execute_runs(ledger, tmp_path, "a process")
    assert ledger.records() == []
    assert len(ledger.left()) == 3


def test_processes_that_make_a_database_at_once(tmp_path):
    for attempt in range(3):
        url = f"sqlite:///{tmp_path}/{attempt}/studies.db"
        children = [forked(lambda url=url: open_storage(url).get_all_studies()) for _ in range(4)]
        assert [os.waitpid(child, 0)[1] for child in children] == [0] * 4


PROXY = """
import optuna, sys
optuna.storages.run_grpc_proxy_server(optuna.storages.get_storage(sys.argv[1]), host="127.0.0.1", port=int(sys.argv[2]))
"""


def test_by_way_of_optunas_proxy(monkeypatch, tmp_path):
    """... which is killed in the middle, and comes back."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-c", PROXY, f"sqlite:///{tmp_path}/studies.db", str(port)]
    sweep = make_sweep(seeds=3)
    servers = []

    def serve():
        servers.append(subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL))

    def train(run, *args):
        if run.seed == 2 and len(servers) == 1:
            servers[0].kill()
            servers[0].wait()
            serve()
        return pretend_to_train(run, *args)

    monkeypatch.setattr(worker, "train", train)
    serve()
    try:
        storage = open_storage(f"grpc://127.0.0.1:{port}")
        ledger = Ledger(storage, "study", GRACE)
        ledger.open(sweep, {"experiment": sweep.name})
        execute_runs(ledger, tmp_path, "a process")
        assert len(servers) == 2
        assert_each_run_once(ledger.trials(), sweep)
        assert len(ledger.records()) == 6
        assert all("beat" in trial.user_attrs[PROGRESS] for trial in ledger.trials())
    finally:
        for server in servers:
            server.send_signal(signal.SIGKILL)
            server.wait()


def test_the_workers_command_trains_all_runs_of_a_study(tmp_path, monkeypatch):
    url = f"sqlite:///{tmp_path}/studies.db"
    ledger = Ledger(open_storage(url), "study", GRACE)
    sweep = make_sweep()
    ledger.open(sweep, {"experiment": sweep.name})
    handled = []
    monkeypatch.setattr("signal.signal", lambda number, handler: handled.append(number))
    monkeypatch.setattr(worker, "train", pretend_to_train)
    benchmark.worker.main(["--study", "study", "--storage", url, "--logs", str(tmp_path), "--device", "cpu"])
    assert handled == [signal.SIGTERM, signal.SIGINT]
    assert_each_run_once(ledger.trials(), sweep)
    assert {trial.user_attrs[WORKER] for trial in ledger.trials()} == {f"{socket.gethostname()}:{os.getpid()}"}
    with pytest.raises(ValueError, match="must be more than two heartbeats"):
        benchmark.worker.main(["--study", "study", "--storage", url, "--logs", str(tmp_path), "--grace", "1"])
