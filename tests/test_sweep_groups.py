"""Which runs of a study a process trains together: the rules, and what becomes of a group whose processes die."""

from collections import Counter

import pytest
import torch as th
import yaml
from optuna.storages import InMemoryStorage
from optuna.trial import TrialState
from studies import (
    GRACE,
    Clock,
    Crew,
    Heart,
    assert_each_run_once,
    make_sweep,
    mortal,
    pretend_to_train,
    pretend_to_train_group,
    work_through,
)

from benchmark.sweep import parse
from benchmark.sweeps import worker_loop as worker
from benchmark.sweeps.execution import worker_command
from benchmark.sweeps.experiments import load_sweep
from benchmark.sweeps.groups import ON_GPU, Group, Groups, population_size
from benchmark.sweeps.run import begin, run_folder
from benchmark.sweeps.sharing import common_settings
from benchmark.sweeps.studies import Ledger
from benchmark.sweeps.study_trials import ERROR, KEY, OUTCOME, POPULATION
from benchmark.worker import parse as parse_worker
from sb3_cgp.resumption.store import StateStore


@pytest.fixture
def ledger():
    """Of four runs that may share a process, seeds 0 to 3."""
    ledger = Ledger(InMemoryStorage(), "study", GRACE, Clock())
    ledger.open(make_sweep(["Good"], seeds=4), {"experiment": "tiny"})
    return ledger


def another(ledger):
    return Ledger(ledger.storage, ledger.name, GRACE, ledger._silence._clock)


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


# --- Which runs may share a process ---


@pytest.fixture
def runs_of(tmp_path):
    """Make the runs of a sweep of two methods, A and B."""

    def make(a, b, **fields):
        methods = {name: {"algo": "cgp", "hyperparams": {"policy": "MlpPolicy"}} | {"tuned": False} for name in ("A", "B")}
        for name, changes in (("A", a), ("B", b)):
            changes = dict(changes)
            methods[name]["algo"] = changes.pop("algo", "cgp")
            methods[name]["tuned"] = changes.pop("tuned", False)
            methods[name]["hyperparams"] |= changes
        content = dict(title="A sweep", methods=methods, tasks=["Pendulum-v1"], steps=1_000, seeds=1, evaluation_interval=50)
        path = tmp_path / "mine.yml"
        path.write_text(yaml.safe_dump(content | fields))
        return load_sweep(str(path)).runs()

    return make


NOISE = dict(noise_type="normal", noise_std=0.1)


@pytest.mark.parametrize(
    ("a", "b", "may_share"),
    [
        ({}, {}, True),
        (dict(learning_rate=0.01, gamma=0.9, tau=0.1), dict(learning_rate="lin_0.001", target_noise_clip=0.1), True),
        (dict(policy_delay=2), dict(policy_delay=3, target_update_interval=1), True),
        (dict(learning_starts=10), dict(learning_starts=100), True),
        (NOISE, NOISE | dict(noise_std=0.3), True),
        (NOISE, {}, False),
        (NOISE, NOISE | dict(noise_type="ornstein-uhlenbeck"), False),
        ({}, dict(batch_size=32), False),
        ({}, dict(cem_samples=32), False),
        ({}, dict(n_steps=3), False),
        ({}, dict(policy_kwargs="dict(net_arch=[64])"), False),
        ({}, dict(policy_loss="qgp"), False),
        ({}, dict(policy_training="offline"), False),
        ({}, dict(algo="td3"), False),
        (dict(algo="td3"), dict(algo="td3", tau=0.1), True),
        (dict(algo="ddpg"), dict(algo="ddpg", learning_rate=0.1), True),
        (dict(algo="td3"), dict(algo="ddpg"), False),
        # The entry of Pendulum-v1 sets the same numbers, and other shapes
        (dict(tuned=True), dict(tuned=True, gamma=0.9), True),
        (dict(tuned=True), dict(), False),
    ],
)  # fmt: skip
def test_runs_share_a_process_that_differ_in_numbers_and_seeds_alone(runs_of, a, b, may_share):
    runs = [common_settings(run) for run in runs_of(a, b, seeds=2)]
    assert None not in runs
    # A and B, with two seeds each
    assert runs[:2] == runs[2:]
    assert (runs[0] == runs[1]) == may_share


@pytest.mark.parametrize(
    "hyperparams",
    [
        dict(algo="sac"),
        dict(algo="tqc"),
        dict(algo="crossq"),
        dict(algo="ppo"),
        dict(algo="random"),
        dict(normalize=True),
        dict(n_envs=2),
        dict(frame_stack=2),
        dict(train_freq=[1, "episode"]),
        dict(cem_dtype="bfloat16"),
        dict(optimize_memory_usage=True),
        dict(policy="sb3_cgp.core.policies.CGPPolicy"),
        dict(callback="stable_baselines3.common.callbacks.StopTrainingOnMaxEpisodes"),
    ],
)
def test_runs_that_a_population_cannot_train_are_trained_alone(runs_of, hyperparams):
    shared = {name: value for name, value in hyperparams.items() if name != "algo"}
    assert {common_settings(run) for run in runs_of(hyperparams, {"algo": hyperparams.get("algo", "cgp")} | shared)} == {None}


def test_runs_on_other_tasks_or_of_other_lengths_do_not_share_a_process(runs_of):
    first = runs_of({}, {})
    others = [runs_of({}, {}, steps=2_000, evaluation_interval=50), runs_of({}, {}, evaluation_interval=100),
              runs_of({}, {}, evaluation_episodes=3), runs_of({}, {}, tasks=["MountainCarContinuous-v0"])]  # fmt: skip
    assert len({common_settings(runs[0]) for runs in (first, *others)}) == 5


# --- What a process takes ---


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
    # Seed 3, which has waited for longer, is not of the group
    assert claim(ledger, tmp_path, 1)[1:] == (None, [3])
    again, same, seeds = claim(ledger, tmp_path, size)
    assert (same, seeds) == (group, [0, 1, 2])
    assert all(ledger.storage.get_trial(each.trial_id).user_attrs[POPULATION] == group.mark for each in again)


def test_runs_of_a_group_that_have_ended_are_not_taken_again(ledger, tmp_path):
    claims, group = begun(ledger, tmp_path)
    ledger.complete(claims[0], 1.0)
    ledger.fail(claims[1], ValueError("NaN"))
    ledger.release(claims[2])
    claim(ledger, tmp_path, 1)
    assert claim(ledger, tmp_path, 8)[1:] == (group, [2])


def test_a_group_without_a_state_here_is_made_anew(ledger, tmp_path):
    claims, _ = begun(ledger, tmp_path / "there")
    for each in claims:
        ledger.release(each)
    _, group, seeds = claim(ledger, tmp_path / "here", 8)
    assert seeds == [3, 0, 1, 2]
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
    for each in claims:
        ledger.release(each)
    claim(ledger, tmp_path, 1)
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
    assert claim(ledger, tmp_path, 8)[2] == [1, 2, 3]
    assert claim(ledger, tmp_path, 8)[1:] == (None, [0])


def test_the_size_of_a_population(monkeypatch):
    assert (parse(["e6"]).population, parse(["e6", "--population"]).population) == ("auto", "auto")
    assert (population_size("auto", "cpu"), population_size(5, "cpu")) == (1, 5)
    monkeypatch.setattr("benchmark.sweeps.groups.get_device", lambda device: type("Device", (), {"type": "cuda"}))
    assert (population_size("auto", "auto"), population_size(5, "cuda")) == (ON_GPU, 5)
    for option in ([], ["--population", "7"]):
        args = parse(["e6", *option])
        assert parse_worker(worker_command(args, "study")[3:]).population == args.population
    with pytest.raises(SystemExit):
        parse(["e6", "--population", "0"])


# --- No run is skipped and none counts twice ---


def trials_of(storage):
    return storage.get_all_trials(storage.get_study_id_from_name("study"))


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


@pytest.mark.parametrize("lack", [MemoryError, getattr(th, "AcceleratorError", th.OutOfMemoryError), ChildProcessError])
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
        def __init__(self, path):
            events.append("locked")

        def __enter__(self):
            pass

        def __exit__(self, *exception):
            events.append("released")

    forget = worker._forget
    monkeypatch.setattr(worker, "FileLock", Lock)
    monkeypatch.setattr(worker, "_forget", lambda *args: events.append("removed") or forget(*args))
    work_through(InMemoryStorage(), make_sweep(["Good"]), clock, tmp_path, population=8)
    assert events == ["locked", "locked", "removed", "released", "released"]


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
