"""A sweep's ledger: no run is skipped and none counts twice, whatever dies between which two steps."""

import errno
import os
import random
import signal
import socket
import time

import pytest
import torch as th
from gymnasium.error import DependencyNotInstalled
from ledgers import forked, trials_of
from optuna.storages import InMemoryStorage
from studies import GRACE, Crew, assert_each_run_once, make_sweep, mortal, pretend_to_train, work_through

import benchmark.worker
from benchmark.common.provenance import machine, processor
from benchmark.sweeps import worker_loop as worker
from benchmark.sweeps.storages import StorageError, open_storage
from benchmark.sweeps.studies import Ledger
from benchmark.sweeps.study_trials import WORKER
from benchmark.sweeps.worker_loop import execute_runs


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


def attempt(ledger, logs, error, steps):
    """Let a process train as a run's training does that raises an error after some steps."""

    def train(run, folder, report, watch, device):
        watch(steps)
        raise error

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(worker, "train", train)
        with pytest.raises(type(error)):
            execute_runs(ledger, logs, "a process")


@pytest.mark.usefixtures("clock")
@pytest.mark.parametrize(
    "error",
    [
        OSError("no such asset"),
        MemoryError("buffer"),
        th.OutOfMemoryError("GPU"),
        ConnectionResetError("simulator"),
        BrokenPipeError("simulator"),
        PermissionError("logs"),
        FileExistsError("logs"),
        ImportError("no Box2D"),
        DependencyNotInstalled("no Box2D"),
    ],
)
@pytest.mark.parametrize(("steps", "attempts"), [(0, 3), (50, 4)])
def test_a_run_that_ends_its_processes_every_time_at_the_same_step_fails(tmp_path, error, steps, attempts):
    ledger = Ledger(InMemoryStorage(), "study", GRACE)
    ledger.open(make_sweep(["Good"], seeds=1), {"experiment": "tiny"})
    for _ in range(attempts):
        assert ledger.records() == []
        attempt(ledger, tmp_path, error, steps)
    (record,) = ledger.records()
    assert (record.final, record.error) == (None, f"{type(error).__name__}: {error}")
    assert ledger.left() == []


@pytest.mark.usefixtures("clock")
def test_a_run_that_gets_further_each_time_is_no_failure(tmp_path):
    ledger = Ledger(InMemoryStorage(), "study", GRACE)
    ledger.open(make_sweep(["Good"], seeds=1), {"experiment": "tiny"})
    for steps in (10, 10, 10, 20, 20, 20, 30):
        attempt(ledger, tmp_path, OSError("disk"), steps)
    assert len(ledger.left()) == 1


@pytest.mark.usefixtures("clock")
@pytest.mark.parametrize(
    "error",
    [
        OSError(errno.ENOSPC, "No space left"),
        OSError(errno.ESTALE, "Stale file handle"),
        OSError(errno.EMFILE, "Too many open files"),
        StorageError("database"),
    ],
)
def test_an_error_of_every_run_is_never_a_failure(tmp_path, error):
    ledger = Ledger(InMemoryStorage(), "study", GRACE)
    ledger.open(make_sweep(["Good"], seeds=1), {"experiment": "tiny"})
    for _ in range(5):
        attempt(ledger, tmp_path, error, 0)
    assert len(ledger.left()) == 1


@pytest.mark.usefixtures("clock")
def test_runs_that_end_their_processes_wait_for_all_others(ledger, tmp_path):
    ends = {0}

    def train(run, *args):
        if run.seed in ends:
            raise MemoryError
        return pretend_to_train(run, *args)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(worker, "train", train)
        for left in (3, 1):
            with pytest.raises(MemoryError):
                execute_runs(ledger, tmp_path, "a process")
            assert len(ledger.left()) == left
        ends.clear()
        execute_runs(ledger, tmp_path, "a process")
    assert_each_run_once(ledger.trials(), make_sweep(["Good"], seeds=3))


@pytest.mark.usefixtures("heeds_interruptions")
def test_the_workers_command_trains_all_runs_of_a_study(tmp_path, monkeypatch):
    url = f"sqlite:///{tmp_path}/studies.db"
    ledger = Ledger(open_storage(url), "study", GRACE)
    sweep = make_sweep()
    ledger.open(sweep, {"experiment": sweep.name})
    handlers = set()

    def train(*args):
        handlers.update(map(signal.getsignal, (signal.SIGTERM, signal.SIGINT)))
        return pretend_to_train(*args)

    monkeypatch.setattr(worker, "train", train)
    benchmark.worker.main(["--study", "study", "--storage", url, "--logs", str(tmp_path), "--device", "cpu"])
    # Of both signals, in every run
    assert len(handlers) == 2
    assert handlers.isdisjoint([signal.SIG_DFL, signal.default_int_handler])
    assert_each_run_once(ledger.trials(), sweep)
    assert {trial.user_attrs[WORKER] for trial in ledger.trials()} == {f"{socket.gethostname()}:{os.getpid()}"}
    here = processor(machine(th.device("cpu")))
    assert all(record.processors == [here] for record in ledger.records())
    for options, message in [
        (["--grace", "1"], "Error: The value of `grace` is 1.0, but must be more than two heartbeats"),
        (["--study", "stduy"], "Error: The value of `study` is 'stduy', but must be a study .* which holds study"),
        (["--storage", "nonsense"], "Error: The value of `storage` is 'nonsense', but must be a database's URL"),
        (["--storage", f"sqlite:///{tmp_path}/x.db"], f"`storage` is .*, but there is no file {tmp_path}/x.db: give"),
    ]:
        with pytest.raises(SystemExit, match=message):
            benchmark.worker.main(["--study", "study", "--storage", url, "--logs", str(tmp_path), *options])
    assert not list(tmp_path.glob("x.db*"))
