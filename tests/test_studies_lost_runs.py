"""Runs whose process is silent, comes back, fails or gives them back."""

import pytest
from ledgers import another, look_for
from optuna.trial import TrialState
from studies import GRACE

from benchmark.sweeps.heartbeats import TrialLostError
from benchmark.sweeps.study_trials import ERROR, KEY, OUTCOME, PROCESSORS, SEED


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


@pytest.mark.parametrize(
    ("attempts", "told"),
    [([["a"]], ["a"]), ([["b"], ["a"]], ["a", "b"]), ([["a"], ["a"]], ["a"]), ([["a"], []], []), ([[], ["a"]], [])],
)
def test_a_run_names_the_processors_of_all_of_its_attempts(ledger, attempts, told):
    for number, processors in enumerate(attempts):
        claim = ledger.claim("one")
        ledger.beat(claim, f"1-{number}", 10, 1.0)
        if processors:
            ledger.annotate(claim, PROCESSORS, processors)
        if number < len(attempts) - 1:
            ledger.release(claim)
            # The other runs, which come first now
            while (
                other := ledger.claim("two", [trial for trial in ledger.trials() if trial.user_attrs[SEED] > 0])
            ) is not None:
                ledger.complete(other, 1.0)
    ledger.complete(claim, 1.0)
    assert {record.seed: record.processors for record in ledger.records()}[0] == told


def test_a_run_between_two_trials_is_left(ledger):
    """All trials have ended, but a run has none: its process was stopped in between."""
    claim = ledger.claim("one")
    while (rest := ledger.claim("one")) is not None:
        ledger.complete(rest, 1.0)
    ledger.storage.set_trial_state_values(claim.trial_id, TrialState.FAIL)
    assert all(trial.state.is_finished() for trial in ledger.trials())
    assert ledger.left() == [claim.run.key]
