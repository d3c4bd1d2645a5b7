"""Groups whose processes die: no run is skipped and none counts twice."""

from collections import Counter

import pytest
import torch as th
from ledgers import trials_of
from optuna.storages import InMemoryStorage
from optuna.trial import TrialState
from studies import Crew, assert_each_run_once, make_sweep, mortal, pretend_to_train, pretend_to_train_group, work_through

from benchmark.sweeps import locks
from benchmark.sweeps import worker_loop as worker
from benchmark.sweeps.groups import Group
from benchmark.sweeps.run import begin
from benchmark.sweeps.study_trials import ERROR, KEY, OUTCOME
from sb3_cgp.resumption.store import StateStore


@pytest.mark.parametrize("takes_effect", [False, True])
def test_a_process_with_a_group_may_die_at_any_call(clock, tmp_path, takes_effect):
    sweep = make_sweep()
    calls = 0
    while True:
        storage, logs = InMemoryStorage(), tmp_path / str(calls)
        has_died = mortal(storage, sweep, clock, logs, calls, takes_effect, population=3)
        work_through(storage, sweep, clock, logs, population=3)
        assert_each_run_once(trials_of(storage), sweep)
        if not has_died:
            break
        calls += 1
    assert calls > 40


@pytest.mark.parametrize("seed", range(20))
def test_processes_with_groups_side_by_side_may_die_lose_answers_and_be_away(clock, tmp_path, seed):
    sweep = make_sweep(seeds=3)
    storage = InMemoryStorage()
    Crew(seed, storage, clock, population=1 + seed % 5).work(sweep, tmp_path, n_processes=3, n_deaths=seed % 8, n_steps=20_000)
    assert_each_run_once(trials_of(storage), sweep)


def test_a_group_that_fails_as_a_whole_is_trained_run_by_run(clock, tmp_path, monkeypatch):
    sweep, storage, tried = make_sweep(), InMemoryStorage(), []

    def train_group(group, *args):
        pretend_to_train_group(Group(group.folder, group.runs), *args)
        raise RuntimeError("a simulator died")

    def train(run, *args):
        tried.append(run.key)
        return pretend_to_train(run, *args)

    monkeypatch.setattr(worker, "train_group", train_group)
    monkeypatch.setattr(worker, "train", train)
    work_through(storage, sweep, clock, tmp_path, population=8)
    trials = trials_of(storage)
    assert_each_run_once(trials, sweep)
    outcomes = Counter(trial.user_attrs.get(OUTCOME) for trial in trials)
    # "Bad" has failed in the group already
    assert outcomes == {None: 4, "dissolved: RuntimeError: a simulator died": 2}
    assert sorted(tried) == ["Good,Pendulum-v1,seed=0", "Good,Pendulum-v1,seed=1"]
    assert not list((tmp_path / "study" / "populations").iterdir())
    assert {trial.user_attrs[KEY] for trial in trials if ERROR in trial.user_attrs} == {
        "Bad,Pendulum-v1,seed=0", "Bad,Pendulum-v1,seed=1"
    }  # fmt: skip


@pytest.mark.parametrize("lack", [MemoryError, th.AcceleratorError, ChildProcessError])
def test_what_the_machine_lacks_gives_a_group_back(clock, tmp_path, monkeypatch, lack):
    storage = InMemoryStorage()

    def train_group(*args):
        raise lack

    with monkeypatch.context() as patch:
        patch.setattr(worker, "train_group", train_group)
        with pytest.raises(lack):
            work_through(storage, make_sweep(), clock, tmp_path, population=8)
    assert Counter(trial.state for trial in trials_of(storage)) == {TrialState.FAIL: 4, TrialState.WAITING: 4}
    work_through(storage, make_sweep(), clock, tmp_path, population=8)
    assert_each_run_once(trials_of(storage), make_sweep())


@pytest.mark.parametrize("population", [1, 8])
def test_states_that_a_killed_process_has_left_are_removed_at_the_end_of_the_study(clock, tmp_path, monkeypatch, population):
    def train(run, folder, *args):
        begin(run, folder)
        StateStore(folder / "state").save(1, {})
        return pretend_to_train(run, folder, *args)

    def killed(*args):
        raise SystemExit

    storage, sweep = InMemoryStorage(), make_sweep(["Good"])
    monkeypatch.setattr(worker, "train", train)
    with monkeypatch.context() as patch:
        patch.setattr(worker, "_forget", killed)
        for _ in range(2):
            with pytest.raises(SystemExit):
                work_through(storage, sweep, clock, tmp_path, population)
            if population > 1:
                break
    assert list(tmp_path.rglob("state-*.json"))
    work_through(storage, sweep, clock, tmp_path, population)
    assert_each_run_once(trials_of(storage), sweep)
    assert not list(tmp_path.rglob("state-*.json"))


def test_states_are_removed_before_another_process_may_continue_from_them(clock, tmp_path, monkeypatch):
    events = []

    class Lock:
        def __init__(self, folder):
            pass

        def acquire(self):
            events.append("locked")

        def release(self):
            events.append("released")

    forget = worker._forget
    monkeypatch.setattr(locks, "FolderLock", Lock)
    monkeypatch.setattr(worker, "_forget", lambda *args: events.append("removed") or forget(*args))
    work_through(InMemoryStorage(), make_sweep(["Good"]), clock, tmp_path, population=8)
    assert events == ["locked", "locked", "removed", "released", "released"]
