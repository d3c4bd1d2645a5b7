"""How far a sweep says it is: the runs that have ended, the speed, and the time left."""

import pytest
from optuna.trial import TrialState, create_trial

from benchmark.sweeps.heartbeats import PROGRESS
from benchmark.sweeps.progress import ProgressTracker
from benchmark.sweeps.study_trials import ERROR, KEY


def trial_of(key, state, step=0, **attributes):
    value = 0.0 if state is TrialState.COMPLETE else None
    attributes = {KEY: key, PROGRESS: {"step": step}} | attributes
    return create_trial(state=state, value=value, user_attrs=attributes)


def test_progress_counts_runs_and_measures_the_speed():
    tally = ProgressTracker(steps=100)
    waiting, done = trial_of("c", TrialState.WAITING), trial_of("a", TrialState.COMPLETE, 100)
    failed = trial_of("d", TrialState.FAIL, 30, **{ERROR: "NaN"})
    lost = trial_of("b", TrialState.FAIL, 80)
    first = tally.add([lost, trial_of("b", TrialState.RUNNING, 20), waiting, done, failed], now=0.0)
    assert (first.runs, first.done, first.running, first.failed) == (4, 1, 1, 1)
    assert first.share == pytest.approx((100 + 100 + 20) / 400)
    assert first.speed is None
    second = tally.add([trial_of("b", TrialState.RUNNING, 60), waiting, done, failed], now=10.0)
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
