"""A tuning's configurations: scored by several seeds, pruned, and recorded where they fail."""

import numpy as np
import pytest
from optuna.storages import InMemoryStorage
from optuna.trial import TrialState
from rl_zoo3 import ALGOS
from tunings import TINY, TINY_CGP

from benchmark.sweeps import tune_execution
from benchmark.sweeps.scoring import SCORING
from benchmark.sweeps.study_trials import ERROR
from benchmark.sweeps.tuner import best_of
from benchmark.sweeps.tuning import SCORES


@pytest.mark.parametrize(("algo", "tiny"), [("cgp", TINY_CGP), ("td3", TINY), ("sac", TINY)])
def test_configurations_are_scored_by_several_seeds(work, tmp_path, algo, tiny):
    trials = work(algo=algo, tiny=tiny)
    assert [trial.state for trial in trials] == [TrialState.COMPLETE] * 2, [trial.user_attrs for trial in trials]
    for trial in trials:
        scores = trial.user_attrs[SCORES]
        assert len(set(scores)) == 2
        assert trial.value == np.mean(scores)
        assert trial.intermediate_values == {0: scores[0], 1: np.mean(scores)}
        for seed in (1, 2):
            folder = tmp_path / "study" / f"trial-{trial.number}" / algo / f"Pendulum-v1_{seed}"
            assert 60 <= ALGOS[algo].load(folder / "Pendulum-v1.zip").num_timesteps < 70
            assert not (folder / "state").exists()
    assert best_of(trials).value == max(trial.value for trial in trials)


def test_a_study_goes_on_and_counts_what_is_over(work, pretend):
    runs = pretend(lambda run: float(run.seed))
    storage = InMemoryStorage()
    assert len(work(storage=storage, trials=2)) == 2
    assert len(work(storage=storage, trials=5)) == 5
    assert len(work(storage=storage, trials=5)) == 5
    assert len(runs) == len(set(runs)) == 10


def test_a_failing_configuration_is_recorded_and_the_study_goes_on(work, pretend):
    def score(run):
        if run.method == "trial-1" and run.seed == 1:
            raise FloatingPointError("NaN in the critic")
        return 1.0

    pretend(score)
    trials = work(trials=4)
    assert [trial.state for trial in trials] == [TrialState.COMPLETE, TrialState.FAIL, *[TrialState.COMPLETE] * 2]
    assert trials[1].user_attrs[ERROR] == "FloatingPointError: NaN in the critic"
    assert trials[1].user_attrs[SCORES] == [1.0]
    assert trials[1].params
    assert "1 failed" in tune_execution.describe(trials, 4)


def test_an_impossible_configuration_fails_by_itself(work):
    trials = work(tiny=[*TINY, "tau=minus one"])
    assert [trial.state for trial in trials] == [TrialState.FAIL] * 2
    assert all(trial.user_attrs[ERROR] for trial in trials)
    assert best_of(trials) is None


def test_pruning_by_the_median_of_scores_so_far(work, pretend):
    runs = pretend(lambda run: -float(run.method.split("-")[1]) + run.seed)
    trials = work(trials=8, seeds=3)
    states = [trial.state for trial in trials]
    assert states == [TrialState.COMPLETE] * 5 + [TrialState.PRUNED] * 3
    assert sum(run[0] == "trial-6" for run in runs) == 1
    assert tune_execution.describe(trials, 8) == "8 of 8 configurations over (3 pruned, 0 failed), 0 running, best 1 (trial 0)"


@pytest.mark.parametrize("score", ["mean", "min"])
def test_a_good_first_seed_does_not_save_what_falls_behind(work, pretend, score):
    pretend(lambda run: 0.0 if int(run.method.split("-")[1]) < 5 else 10.0 - 25.0 * run.seed)
    trials = work("--score", score, trials=6, seeds=3)
    assert [trial.state for trial in trials] == [TrialState.COMPLETE] * 5 + [TrialState.PRUNED]
    assert list(trials[5].intermediate_values) == [0, 1]


def test_pruning_by_wilcoxons_test_of_paired_seeds(work, pretend):
    """Seeds differ by more than configurations, as in life; paired, these are told apart."""
    runs = pretend(lambda run: 100.0 * run.seed - float(run.method.split("-")[1]) * (1 + 0.1 * run.seed))
    trials = work("--pruner", "wilcoxon", trials=3, seeds=8)
    assert [trial.state for trial in trials] == [TrialState.COMPLETE, TrialState.PRUNED, TrialState.PRUNED]
    # The fourth seed is the first that can be sure enough
    assert sum(run[0] == "trial-1" for run in runs) == 4
    assert trials[1].intermediate_values == {seed: 100.0 * seed - (1 + 0.1 * seed) for seed in range(4)}


def test_scores():
    returns = [0.0, 10.0, 11.0, 100.0]
    assert {name: score(returns) for name, score in SCORING.items()} == {"mean": 30.25, "iqm": 10.5, "min": 0.0}
