"""Which runs of a study a process takes, to train them together."""

import pytest
from ledgers import another
from optuna.storages import InMemoryStorage
from optuna.trial import TrialState
from studies import GRACE, Clock, Heart, make_sweep

from benchmark.sweep import parse
from benchmark.sweeps import worker_loop as worker
from benchmark.sweeps.attempts import outcome_of
from benchmark.sweeps.execution import worker_command
from benchmark.sweeps.groups import ON_GPU, Groups, population_size
from benchmark.sweeps.run import begin, run_folder
from benchmark.sweeps.studies import Ledger
from benchmark.sweeps.study_trials import POPULATION
from benchmark.worker import parse as parse_worker
from sb3_cgp.resumption.store import StateStore


@pytest.fixture
def ledger():
    """Of four runs that may share a process, seeds 0 to 3."""
    ledger = Ledger(InMemoryStorage(), "study", GRACE, Clock())
    ledger.open(make_sweep(["Good"], seeds=4), {"experiment": "tiny"})
    return ledger


def claim(ledger, logs, size):
    claims, group = Groups(logs, "study", size).claim(ledger, "a process")
    return claims, group, [claim.run.seed for claim in claims]


def lose(ledger, *silent):
    """Let the grace period pass, in which the silent trials alone send no heartbeat."""
    clock = ledger._silence._clock
    for second in range(0, round(GRACE) + 10, 5):
        for trial in ledger.trials():
            if trial.state is TrialState.RUNNING and trial.number not in silent:
                trial_id = ledger._id(trial)
                ledger.storage.set_trial_user_attr(trial_id, "progress", {"beat": f"{second}"})
        ledger.recover()
        clock.sleep(5)


@pytest.mark.parametrize(("size", "groups"), [(1, [[0], [1], [2], [3]]), (3, [[0, 1, 2], [3]]), (8, [[0, 1, 2, 3]])])
def test_a_process_takes_as_many_runs_as_it_may(ledger, tmp_path, size, groups):
    for seeds in groups:
        claims, group, taken = claim(ledger, tmp_path, size)
        assert taken == seeds
        assert (group is None) == (len(seeds) == 1)
        marks = [ledger.storage.get_trial(each.trial_id).user_attrs.get(POPULATION) for each in claims]
        assert marks == [None if group is None else {"name": group.folder.name, "agents": len(seeds)}] * len(seeds)
    assert claim(ledger, tmp_path, size)[:2] == ([], None)


def test_a_run_of_another_kind_does_not_come_along(tmp_path):
    ledger = Ledger(InMemoryStorage(), "study")
    ledger.open(make_sweep(["Good", "Other"], seeds=2, hyperparams={}), {"experiment": "tiny"})
    for trial in ledger.trials():
        if trial.user_attrs["run"]["method"] == "Other":
            run = trial.user_attrs["run"] | {"algo": "sac"}
            ledger.storage.set_trial_user_attr(ledger._id(trial), "run", run)
    taken = [claim(ledger, tmp_path, 8)[0] for _ in range(3)]
    assert [[each.run.key for each in claims] for claims in taken] == [
        ["Good,Pendulum-v1,seed=0", "Good,Pendulum-v1,seed=1"], ["Other,Pendulum-v1,seed=0"], ["Other,Pendulum-v1,seed=1"]
    ]  # fmt: skip


def begun(ledger, logs, size=3):
    """Take a group of runs, and save a state of it."""
    claims, group, _ = claim(ledger, logs, size)
    group.write()
    StateStore(group.states).save(1, {})
    return claims, group


@pytest.mark.parametrize("size", [1, 2, 8])
def test_a_group_goes_on_as_it_is_whatever_the_size_is_now(ledger, tmp_path, size):
    claims, group = begun(ledger, tmp_path)
    for each in claims:
        ledger.release(each)
    again, same, seeds = claim(ledger, tmp_path, size)
    assert (same, seeds) == (group, [0, 1, 2])
    # Seed 3, which has waited for longer, is not of the group
    assert claim(ledger, tmp_path, size)[1:] == (None, [3])
    assert all(ledger.storage.get_trial(each.trial_id).user_attrs[POPULATION] == group.mark for each in again)


def test_runs_of_a_group_that_have_ended_are_not_taken_again(ledger, tmp_path):
    claims, group = begun(ledger, tmp_path)
    ledger.complete(claims[0], 1.0)
    ledger.fail(claims[1], ValueError("NaN"))
    ledger.release(claims[2])
    assert claim(ledger, tmp_path, 8)[1:] == (group, [2])


def test_a_group_without_a_state_here_is_made_anew(ledger, tmp_path):
    claims, _ = begun(ledger, tmp_path / "there")
    for each in claims:
        ledger.release(each)
    _, group, seeds = claim(ledger, tmp_path / "here", 8)
    # By their place in the sweep, though new trials have been enqueued for the first three
    assert seeds == [0, 1, 2, 3]
    assert len(group.runs) == 4


def test_a_group_is_not_taken_while_a_run_of_it_is_still_trained(ledger, tmp_path):
    claims, group = begun(ledger, tmp_path)
    claim(ledger, tmp_path, 1)
    other = another(ledger)
    # One heartbeat of the process is missing
    lose(other, 1)
    assert [trial.state for trial in ledger.trials()[:3]] == [TrialState.RUNNING, TrialState.FAIL, TrialState.RUNNING]
    assert claim(other, tmp_path, 8)[:2] == ([], None)
    # It notices, and gives the others back
    for each in (claims[0], claims[2]):
        ledger.release(each)
    assert claim(other, tmp_path, 8)[1:] == (group, [0, 1, 2])


def test_a_process_that_comes_second_leaves_a_group_to_the_first(ledger, tmp_path):
    claims, group = begun(ledger, tmp_path)
    claim(ledger, tmp_path, 1)
    for each in claims:
        ledger.release(each)
    groups = Groups(tmp_path, "study", 8)
    seen = ledger.trials()
    # In the meantime, the first trial is taken, and not marked yet
    first = next(trial for trial in ledger.trials() if trial.state is TrialState.WAITING)
    ledger.storage.set_trial_state_values(ledger._id(first), TrialState.RUNNING)
    assert list(groups.plans(ledger.trials())) == []
    (plan,) = groups.plans(seen)
    assert plan.group == group
    assert ledger.claim("second", plan.trials[:1]) is None
    ledger.storage.set_trial_user_attr(ledger._id(first), POPULATION, group.mark)
    assert list(groups.plans(ledger.trials())) == []


def test_a_run_that_began_alone_goes_on_alone(ledger, tmp_path):
    (taken,), _, _ = claim(ledger, tmp_path, 1)
    folder = run_folder(tmp_path, "study", taken.run)
    begin(taken.run, folder)
    StateStore(folder / "state").save(1, {})
    ledger.release(taken)
    assert claim(ledger, tmp_path, 8)[1:] == (None, [0])
    assert claim(ledger, tmp_path, 8)[2] == [1, 2, 3]


def give_back(ledger, claims, logs, with_state=()):
    """Give runs back as an interrupted process does, some with a state."""
    for each in claims:
        if each.run.seed in with_state:
            folder = run_folder(logs, "study", each.run)
            begin(each.run, folder)
            StateStore(folder / "state").save(1, {})
        ledger.release(each)


@pytest.mark.parametrize("size", [1, 2])
def test_interrupted_runs_go_on_before_others_begin(ledger, tmp_path, size):
    claims = [claim(ledger, tmp_path, 1)[0][0] for _ in range(3)]
    give_back(ledger, [claims[2], claims[0], claims[1]], tmp_path, with_state=(1, 2))
    assert claim(ledger, tmp_path, size)[1:] == (None, [1])
    assert claim(ledger, tmp_path, size)[1:] == (None, [2])
    # Seed 0, whose process was stopped before its first state, keeps its place
    assert claim(ledger, tmp_path, size)[2] == [0, 3][:size]


def test_a_run_that_an_error_has_ended_waits_for_all_others_whatever_its_progress(ledger, tmp_path):
    (taken,), _, _ = claim(ledger, tmp_path, 1)
    ledger.beat(taken, "beat", 50, 1.0)
    begin(taken.run, run_folder(tmp_path, "study", taken.run))
    StateStore(run_folder(tmp_path, "study", taken.run) / "state").save(50, {})
    ledger.release(taken, outcome_of(BrokenPipeError("simulator")))
    assert [claim(ledger, tmp_path, 1)[2] for _ in range(4)] == [[1], [2], [3], [0]]


def test_sessions_shorter_than_a_run_finish_one_run_after_another(ledger, tmp_path):
    finished = []
    for session in range(8):
        (taken,), _, (seed,) = claim(ledger, tmp_path, 1)
        if session % 2:
            ledger.complete(taken, 0.0)
            finished.append(seed)
        else:
            give_back(ledger, [taken], tmp_path, with_state=(seed,))
    assert finished == [0, 1, 2, 3]


def test_a_state_on_another_machine_gives_no_preference(ledger, tmp_path):
    claims = [claim(ledger, tmp_path / "there", 1)[0][0] for _ in range(2)]
    give_back(ledger, claims, tmp_path / "there", with_state=(1,))
    assert claim(ledger, tmp_path / "here", 1)[2] == [0]


def test_runs_that_another_machine_may_continue_come_after_those_that_nobody_has_begun(ledger, tmp_path):
    (taken,), *_ = claim(ledger, tmp_path / "there", 1)
    ledger.beat(taken, "1", 50, 1.0)
    give_back(ledger, [taken], tmp_path / "there", with_state=(0,))
    assert [claim(ledger, tmp_path / "here", 1)[2] for _ in range(4)] == [[1], [2], [3], [0]]


def test_a_population_that_ends_its_processes_every_time_is_dissolved(ledger, tmp_path, monkeypatch):
    def train_group(group, folders, claimed, watch, device):
        group.write()
        StateStore(group.states).save(1, {})
        raise MemoryError

    monkeypatch.setattr(worker, "train_group", train_group)
    monkeypatch.setattr(worker, "HeartbeatThread", Heart)
    for _ in range(3):
        claims, group, seeds = claim(ledger, tmp_path, 8)
        assert seeds == [0, 1, 2, 3]
        with pytest.raises(MemoryError):
            worker._train_claimed(ledger, claims, group, tmp_path, 1.0, None, "cpu")
    assert claim(ledger, tmp_path, 8)[1:] == (None, [0])
    assert ledger.records() == []


@pytest.mark.usefixtures("clock")
@pytest.mark.parametrize("size", [1, 8])
@pytest.mark.parametrize("is_same", [True, False])
def test_the_time_of_a_run_that_another_storage_began_is_not_known(tmp_path, size, is_same):
    """Its state is here, but its first trials and their times are in the other storage."""
    first, second = (Ledger(InMemoryStorage(), "study", GRACE, Clock()) for _ in range(2))
    for each in (first, second):
        each.open(make_sweep(["Good"], seeds=2), {"experiment": "tiny"})
    claims, group, _ = claim(first, tmp_path, size)
    for each in claims:
        first.beat(each, "1-0", 50, 7.0, 7.0)
    if group is not None:
        group.write()
        StateStore(group.states).save(1, {})
    give_back(first, claims, tmp_path, with_state=(0,) if group is None else ())
    ledger = first if is_same else second
    worker.execute_runs(ledger, tmp_path, "a process", population=size)
    times = {record.seed: record.seconds for record in ledger.records()}
    assert times[0] == (8.0 if is_same else None)
    # Of a population, all runs have the state
    assert times[1] == (1.0 if size == 1 else times[0])


def test_the_size_of_a_population(monkeypatch):
    assert parse(["e6"]).population == "auto"
    assert (population_size("auto", "cpu"), population_size(5, "cpu")) == (1, 5)
    monkeypatch.setattr("benchmark.sweeps.groups.get_device", lambda device: type("Device", (), {"type": "cuda"}))
    assert (population_size("auto", "auto"), population_size(5, "cuda")) == (ON_GPU, 5)
    for option in ([], ["--population", "7"]):
        args = parse(["e6", *option])
        assert parse_worker(worker_command(args, "study")[3:]).population == args.population
    with pytest.raises(SystemExit):
        parse(["e6", "--population", "0"])


def test_a_process_that_was_taken_for_lost_leaves_the_states_to_its_successor(ledger, tmp_path, monkeypatch):
    def train_group(group, folders, claimed, watch, device):
        group.write()
        StateStore(group.states).save(1, {})
        for trial in ledger.trials():
            if trial.state is TrialState.RUNNING:
                ledger._end(ledger._id(trial), TrialState.FAIL, outcome="lost")
        raise RuntimeError("an error of its own")

    claims, group, _ = claim(ledger, tmp_path, 8)
    monkeypatch.setattr(worker, "train_group", train_group)
    monkeypatch.setattr(worker, "HeartbeatThread", Heart)
    worker._train_claimed(ledger, claims, group, tmp_path, 1.0, None, "cpu")
    assert StateStore(group.states).steps() == [1]
