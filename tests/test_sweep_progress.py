"""How far a sweep says it is: the runs that have ended, the speed, and the time left."""

import pytest
from optuna.trial import TrialState, create_trial

from benchmark.sweeps.heartbeats import PROGRESS
from benchmark.sweeps.progress import ProgressTracker
from benchmark.sweeps.study_trials import CONTINUED, ERROR, KEY


def trial_of(key, state, step=0, attempt=0, **attributes):
    value = 0.0 if state is TrialState.COMPLETE else None
    attributes = {KEY: key, PROGRESS: {"step": step}} | attributes
    trial = create_trial(state=state, value=value, user_attrs=attributes)
    trial.number = 100 * attempt + ord(key)
    return trial


def test_progress_counts_runs_and_measures_the_speed():
    tally = ProgressTracker(steps=100)
    waiting, done = trial_of("c", TrialState.WAITING), trial_of("a", TrialState.COMPLETE, 100)
    failed = trial_of("d", TrialState.FAIL, 30, **{ERROR: "NaN"})
    lost = trial_of("b", TrialState.FAIL, 80)
    first = tally.add([lost, trial_of("b", TrialState.RUNNING, 20, 1), waiting, done, failed], now=0.0)
    assert (first.runs, first.done, first.running, first.failed) == (4, 1, 1, 1)
    assert first.share == pytest.approx((100 + 100 + 20) / 400)
    assert first.speed is None
    second = tally.add([trial_of("b", TrialState.RUNNING, 60, 1), waiting, done, failed], now=10.0)
    assert second.speed == pytest.approx(4.0)
    assert second.seconds_left == pytest.approx((400 - 260) / 4)
    assert "1 of 4 runs done, 1 running, 1 failed, 4 steps/s, 0:00:35 left" in str(second)


def test_the_time_left_counts_the_time_in_which_no_environment_moves():
    tally, waiting = ProgressTracker(steps=100), trial_of("b", TrialState.WAITING)
    tally.add([trial_of("a", TrialState.RUNNING, 0), waiting], now=0.0)
    tally.add([trial_of("a", TrialState.RUNNING, 100), waiting], now=50.0)
    # Its policy is trained offline
    standing = tally.add([trial_of("a", TrialState.RUNNING, 100), waiting], now=200.0)
    assert standing.speed is None
    assert standing.seconds_left == pytest.approx(200.0)


def test_the_time_left_forgets_what_is_long_past():
    tally, runs = ProgressTracker(steps=1000), [trial_of("b", TrialState.WAITING)]
    steps_by = {0.0: 0, 4000.0: 10, 7600.0: 910}
    standings = [tally.add([trial_of("a", TrialState.RUNNING, step), *runs], now) for now, step in steps_by.items()]
    assert standings[-1].seconds_left == pytest.approx((2000 - 910) / (900 / 3600))


@pytest.mark.parametrize("is_known", [True, False], ids=["lost here", "of another storage"])
def test_steps_of_a_state_are_no_speed(is_known):
    tally, waiting = ProgressTracker(steps=1000), trial_of("b", TrialState.WAITING)
    lost = [trial_of("a", TrialState.FAIL, 800)] if is_known else []
    # As trials of another storage's state are named when they have loaded it
    marks = {} if is_known else {CONTINUED: True}
    tally.add([*lost, trial_of("a", TrialState.WAITING, 0, 1), waiting], now=0.0)
    tally.add([*lost, trial_of("a", TrialState.RUNNING, 0, 1), waiting], now=5.0)
    loaded = tally.add([*lost, trial_of("a", TrialState.RUNNING, 700, 1, **marks), waiting], now=10.0)
    assert loaded.speed is None
    going = tally.add([*lost, trial_of("a", TrialState.RUNNING, 740, 1, **marks), waiting], now=20.0)
    assert going.speed == pytest.approx(40 / 20)
    assert going.seconds_left == pytest.approx((2000 - 740) / 2)
    assert going.share == pytest.approx(740 / 2000)


def test_runs_that_were_lost_keep_the_steps_that_they_took():
    tally = ProgressTracker(steps=100)
    tally.add([trial_of("a", TrialState.RUNNING, 10)], now=0.0)
    lost = trial_of("a", TrialState.FAIL, 50)
    standing = tally.add([lost, trial_of("a", TrialState.WAITING, 0, 1)], now=10.0)
    assert standing.speed == pytest.approx(4.0)


def test_a_run_that_fails_has_not_taken_all_of_its_steps():
    tally, waiting = ProgressTracker(steps=1000), trial_of("b", TrialState.WAITING)
    tally.add([trial_of("a", TrialState.RUNNING, 10), waiting], now=0.0)
    failed = tally.add([trial_of("a", TrialState.FAIL, 30, **{ERROR: "NaN"}), waiting], now=10.0)
    assert failed.speed == pytest.approx(2.0)
    assert failed.seconds_left == pytest.approx(1000 / 2)
