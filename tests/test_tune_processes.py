"""Configurations that a process has left, or that several processes take."""

import time
from itertools import count

import optuna
import pytest
from optuna.storages import InMemoryStorage
from optuna.trial import TrialState
from studies import Heart, Line
from tunings import arguments, samples, tuner_of

from benchmark import tune
from benchmark.sweeps import tuner
from benchmark.sweeps.storages import patient
from benchmark.sweeps.study_trials import ERROR, LOST, TUNING
from benchmark.sweeps.tuning import ORIGIN, SCORES
from benchmark.sweeps.validation import SweepError


def test_a_stopped_configuration_is_taken_up_where_it_was(work, pretend):
    storage, stops = InMemoryStorage(), iter([True])

    def score(run):
        if run.seed == 1 and next(stops, False):
            raise SystemExit(143)
        return float(run.seed)

    runs = pretend(score)
    with pytest.raises(SystemExit):
        work(storage=storage, trials=1)
    (
        stopped,
        again,
    ) = work(storage=storage, trials=1)
    assert (stopped.state, again.state, again.value) == (TrialState.FAIL, TrialState.COMPLETE, 0.5)
    assert again.params == stopped.params
    assert again.user_attrs[ORIGIN] == stopped.number
    # The first seed is not trained again, and the second in the same folder
    assert runs == [("trial-0", 0), ("trial-0", 1), ("trial-0", 1)]


def test_a_configuration_that_is_stopped_while_it_is_suggested_again_stays_whole(work, pretend, tmp_path):
    storage = InMemoryStorage()
    tuner = tuner_of(tune.parse(arguments("--logs", str(tmp_path))), storage)
    (params,) = (params for _, params in list(samples("td3"))[:1])
    tuner._study.enqueue_trial(params, {SCORES: [3.0], ORIGIN: 7})
    trial = tuner._study.ask()
    trial.suggest_float("one_minus_gamma", 0.0001, 0.03, log=True)
    tuner._give_back(trial.number, "given back")
    runs = pretend(lambda run: 1.0)
    again = work(storage=storage, trials=1)[-1]
    assert (again.state, again.params, again.user_attrs[SCORES]) == (TrialState.COMPLETE, params, [3.0, 1.0])
    assert runs == [("trial-7", 1)]


def test_a_lost_configuration_is_taken_up_by_another_process(work, pretend, tmp_path):
    storage = InMemoryStorage()

    class Killed(BaseException):
        pass

    runs = pretend(lambda run: float(run.seed))
    args = tune.parse(arguments("--logs", str(tmp_path)))
    dying = tuner_of(args, storage)
    dying._give_back = lambda *_: None
    scored = tuner.train

    def die(run, *more):
        if run.seed == 1:
            raise Killed
        return scored(run, *more)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tuner, "train", die)
        with pytest.raises(Killed):
            dying.attempt(tmp_path, 5.0, None, "cpu")
    other = tuner_of(args, storage, grace=0.01)
    other.recover()
    time.sleep(0.1)
    other.recover()
    assert [trial.state for trial in other.trials()] == [TrialState.FAIL, TrialState.WAITING]
    lost, again = work(storage=storage, trials=1)
    assert (again.value, again.params) == (0.5, lost.params)
    assert runs == [("trial-0", 0), ("trial-0", 1)]


@pytest.mark.parametrize("error", [OSError("no such asset"), MemoryError("buffer"), BrokenPipeError("simulator")])
def test_a_configuration_that_ends_its_processes_every_time_fails_and_the_next_is_trained(work, pretend, error):
    storage = InMemoryStorage()

    def score(run):
        if run.method == "trial-0" and run.seed == 1:
            raise error
        return 1.0

    runs = pretend(score)
    for _ in range(4):
        with pytest.raises(type(error)):
            work(storage=storage, trials=2)
    trials = work(storage=storage, trials=2)
    assert [trial.state for trial in trials] == [TrialState.FAIL] * 4 + [TrialState.COMPLETE]
    assert [ERROR in trial.user_attrs for trial in trials] == [False] * 3 + [True, False]
    assert trials[3].user_attrs[ERROR] == f"{type(error).__name__}: {error}"
    assert runs[-2:] == [("trial-4", 0), ("trial-4", 1)]


def test_a_configuration_whose_processes_are_lost_every_time_fails(tmp_path):
    storage = InMemoryStorage()
    tuner = tuner_of(tune.parse(arguments("--logs", str(tmp_path))), storage)
    for _ in range(3):
        trial = tuner._study.ask()
        tuner._tuning.sample(trial)
        tuner._give_back(trial.number, LOST)
    assert [trial.state for trial in tuner.trials()] == [TrialState.FAIL] * 3
    assert [trial.user_attrs.get(ERROR) for trial in tuner.trials()] == [None, None, LOST]


def test_a_process_that_was_given_up_leaves_the_trial_alone(work, pretend, tmp_path):
    storage = InMemoryStorage()
    args = tune.parse(arguments("--logs", str(tmp_path)))
    tuner = tuner_of(args, storage)

    def score(run):
        if run.seed == 1:
            tuner._give_back(0, "lost: its process fell silent")
        return 1.0

    pretend(score)
    tuner.attempt(tmp_path, 5.0, None, "cpu")
    assert [trial.state for trial in tuner.trials()] == [TrialState.FAIL, TrialState.WAITING]
    assert ERROR not in tuner.trials()[0].user_attrs


@pytest.mark.usefixtures("clock")
@pytest.mark.parametrize("waits", [False, True])
@pytest.mark.parametrize("takes_effect", [False, True])
def test_a_call_that_the_database_does_not_answer_is_repeated_alone(
    pretend, tmp_path, monkeypatch, capsys, waits, takes_effect
):
    """
    It is one after another of all calls of an attempt, those of Optuna's ``ask`` included.

    A trial is left to be found silent only where it was made or taken, and the answer was lost.
    """
    monkeypatch.setattr(tuner, "HeartbeatThread", Heart)
    pretend(lambda run: 1.0)
    args = tune.parse(arguments("--logs", str(tmp_path)))
    left_behind = 0
    for calls in count():
        faults = []
        line = Line(InMemoryStorage(), lambda faults=faults: faults.pop(0) if faults else None)
        own = tuner_of(args, patient(line))
        if waits:
            own._study.enqueue_trial({"one_minus_gamma": 0.01})
        faults += [None] * calls + [(ConnectionError, takes_effect)]
        own.attempt(tmp_path / str(calls), 5.0, None, "cpu")
        *others, last = own.trials()
        assert (last.state, last.value) == (TrialState.COMPLETE, 1.0)
        assert [(trial.state, trial.params) for trial in others] in ([], [(TrialState.RUNNING, {})])
        left_behind += len(others)
        if faults:
            break
    assert calls > 20
    assert left_behind == takes_effect
    printed = capsys.readouterr()
    assert "was given to another process" not in printed.out
    assert printed.err.count("The storage does not answer (ConnectionError)") == calls


def test_a_study_is_not_opened_with_other_settings(work, pretend):
    pretend(lambda run: 1.0)
    storage = InMemoryStorage()
    work(storage=storage)
    with pytest.raises(SweepError, match=r"'study': seeds: was 2 and is now 3.*--study"):
        work(storage=storage, seeds=3)


def test_a_study_of_another_version_is_refused_in_words(work, pretend):
    pretend(lambda run: 1.0)
    storage = InMemoryStorage()
    work(storage=storage)
    study = optuna.load_study(study_name="study", storage=storage)
    study.set_user_attr(TUNING, study.user_attrs[TUNING] | {"sampler": "random"})
    with pytest.raises(SweepError, match=r"'study': sampler: was 'random' and is now None.*--study"):
        work(storage=storage)
