"""Scores and statistics of sweeps against counts by hand."""

import math
from pathlib import Path

import numpy as np
import pytest
from finished_studies import record, runs, study
from rliable import metrics
from rliable.library import get_interval_estimates

from benchmark.reporting.estimates import (
    bootstrap,
    cells_of,
    compare,
    estimate,
    interquartile_mean,
    probability_of_improvement,
    share_reaching,
)
from benchmark.reporting.scores import curves, evaluation_grid, floors, score_table, settings_in_words


def test_failed_run_counts_with_the_lowest_return_of_any_evaluation_on_its_task(tmp_path: Path) -> None:
    records = [
        record("CGP-Online", 0, -150.0, returns=[-1_700.0, -150.0]),
        record("TD3", 0, None, returns=[-1_200.0, math.nan]),
        record("SAC", 0, None, returns=[-900.0]),
        record("TD3", 0, None, task="Reacher-v5", returns=[]),
        record("TD3", 1, -4.0, task="Reacher-v5", returns=[-60.0, -4.0]),
    ]
    table = score_table([study(tmp_path, records)]).set_index(["task", "method", "seed"])
    assert dict(table["score"]) == {
        ("Pendulum-v1", "CGP-Online", 0): -150.0,
        ("Pendulum-v1", "TD3", 0): -1_700.0,
        ("Pendulum-v1", "SAC", 0): -1_700.0,
        ("Reacher-v5", "TD3", 0): -60.0,
        ("Reacher-v5", "TD3", 1): -4.0,
    }
    assert table["failed"].sum() == 3
    assert list(table["share"].sort_values()) == [0.0, 0.0, 0.0, 1.0, 1.0]


def test_runs_that_all_failed_before_an_evaluation_tie(tmp_path: Path) -> None:
    records = [record("TD3", seed, None, returns=[]) for seed in (0, 1)]
    table = score_table([study(tmp_path, records)])
    assert list(table["score"]) == list(table["share"]) == [0.0, 0.0]


def test_runs_of_different_length_on_one_task_are_kept_apart(tmp_path: Path) -> None:
    long, short = (study(tmp_path, [record("TD3", 0, 1.0, steps=steps)], f"s{steps}") for steps in (1_000, 500))
    assert set(score_table([long, short])["task"]) == {"Pendulum-v1, 1,000 steps", "Pendulum-v1, 500 steps"}


def test_curve_of_a_failed_run_goes_on_at_the_floor() -> None:
    records = [record("TD3", 0, 8.0, returns=[1.0, 2.0, 4.0, 8.0]), record("TD3", 1, None, returns=[3.0, 5.0])]
    grid = evaluation_grid(records, "Pendulum-v1")
    lines = curves(records, floors(records)["Pendulum-v1"], grid)
    assert grid.tolist() == [250, 500, 750, 1_000]
    assert lines.tolist() == [[1.0, 2.0, 4.0, 8.0], [3.0, 5.0, 1.0, 1.0]]


def test_curves_end_where_the_first_run_ends() -> None:
    """Some algorithms train for longer than they are told."""
    records = [record("TD3", 0, 4.0, returns=[1.0, 4.0]), record("PPO", 0, 3.0, returns=[0.0, 1.0, 2.0, 3.0])]
    records.append(record("PPO", 1, None, returns=[2.0]))
    grid = evaluation_grid(records, "Pendulum-v1")
    assert curves(records, 0.0, grid).tolist() == [[1.0, 4.0], [0.0, 1.0], [2.0, 0.0]]


def test_configurations_that_agree_in_many_digits_are_kept_apart(tmp_path: Path) -> None:
    records = [record("TD3", seed, 1.0, settings={"gamma": gamma}) for gamma in (0.9999999, 1.0, 0.001) for seed in (0, 1)]
    table = score_table([study(tmp_path, records)])
    assert table.groupby("cell").size().tolist() == [2, 2, 2]
    assert list(table["settings"].unique()) == ["gamma 0.9999999", "gamma 1", "gamma 0.001"]


def test_stability_is_a_count_of_runs() -> None:
    rng = np.random.default_rng(0)
    cells = [rng.integers(10, size=4).astype(float) for _ in range(6)]
    levels = np.unique(np.concatenate(cells))
    share, band = bootstrap(lambda scores: share_reaching(scores, levels), [dict(enumerate(cells))], 200)
    counted = [sum(score >= level for cell in cells for score in cell) / 24 for level in levels]
    assert share.tolist() == pytest.approx(counted)
    assert band is not None
    assert np.all(band[0] <= share)
    assert np.all(share <= band[1])
    assert share[0] == 1.0


def test_interquartile_mean_is_that_of_rliable_for_cells_of_any_size() -> None:
    rng = np.random.default_rng(1)
    cells = [rng.normal(size=number) for number in (4, 6, 4, 5)]
    found = estimate(interquartile_mean, [dict(enumerate(cells))], 500)
    pooled = np.concatenate(cells)
    assert found.value == pytest.approx(metrics.aggregate_iqm(pooled))
    assert found.runs == 19
    assert found.interval is not None
    assert found.interval[0] < found.value < found.interval[1]
    lines = rng.normal(size=(5, 7))
    assert interquartile_mean(lines[None])[0] == pytest.approx([metrics.aggregate_iqm(column) for column in lines.T])


def test_the_interval_of_four_runs_is_their_range() -> None:
    rng = np.random.default_rng(5)
    for number in (4, 5):
        scores = rng.normal(size=number)
        is_range = estimate(interquartile_mean, [{0: scores}], 2_000).interval == (scores.min(), scores.max())
        assert is_range == (number == 4)


def test_runs_are_drawn_within_cells_only() -> None:
    cells = [np.zeros(4), np.full(4, 10.0)]
    assert estimate(lambda scores: scores.mean(axis=1), [dict(enumerate(cells))], 50).interval == (5.0, 5.0)


@pytest.mark.parametrize("number", [1, 2, 3])
def test_too_few_runs_of_a_configuration_have_no_interval(number: int) -> None:
    found = estimate(interquartile_mean, [{0: np.full(number, 3.0)}], 50)
    assert (found.value, found.interval) == (3.0, None)
    assert found.in_words(".1f") == "3.0 (no interval)"
    assert estimate(interquartile_mean, [{0: np.arange(4.0), 1: np.arange(float(number))}], 50).interval is None
    assert estimate(interquartile_mean, [{0: np.arange(4.0)}], 50).interval is not None


def test_estimates_repeat_and_leave_the_global_random_state_alone() -> None:
    cells = {0: np.random.default_rng(3).normal(size=5)}
    state = np.random.get_state()[1].tolist()  # noqa: NPY002
    first = estimate(interquartile_mean, [cells], 100)
    assert np.random.get_state()[1].tolist() == state  # noqa: NPY002
    np.random.seed(5)  # noqa: NPY002
    assert estimate(interquartile_mean, [cells], 100) == first


def test_better_method_improves_surely_and_ties_count_half(tmp_path: Path) -> None:
    better = {"CGP-Online": 10.0, "TD3": 0.0, "SAC": 10.0}
    records = runs(lambda method, _, seed: better[method] + seed, better, tasks=("Pendulum-v1", "Reacher-v5"))
    table = score_table([study(tmp_path, records)])
    found = compare(table, ("CGP-Online", "TD3"), probability_of_improvement, "score", 100)
    assert found is not None
    assert (found.value, found.interval) == (1.0, (1.0, 1.0))
    tied = compare(table, ("CGP-Online", "SAC"), probability_of_improvement, "score", 100)
    assert tied is not None
    assert tied.value == 0.5


def test_probability_is_that_of_rliable() -> None:
    rng = np.random.default_rng(4)
    for ours, theirs in (rng.normal(size=(2, 4)), rng.integers(3, size=(2, 12)).astype(float)):
        expected = metrics.probability_of_improvement(ours[:, None], theirs[:, None])
        assert probability_of_improvement(ours[None], theirs[None])[0] == pytest.approx(expected)


def test_intervals_are_those_of_rliable() -> None:
    scores = np.random.default_rng(5).normal(size=(6, 3))
    found = estimate(interquartile_mean, [dict(enumerate(scores.T))], 2_000)
    _, expected = get_interval_estimates({"": scores}, lambda each: np.array([metrics.aggregate_iqm(each)]), reps=2_000)
    assert found.interval == pytest.approx(tuple(expected[""].ravel()), abs=0.05)


def test_methods_are_compared_where_both_ran(tmp_path: Path) -> None:
    configurations = [{"width": 32}, {"width": 64}]
    records = runs(lambda *_: 1.0, ["CGP-Online"], configurations) + runs(lambda *_: 0.0, ["TD3"], configurations[:1])
    table = score_table([study(tmp_path, records)])
    found = compare(table, ("CGP-Online", "TD3"), lambda *both: sum(np.ones(1) * each.shape[1] for each in both), "score", 10)
    assert found is not None
    assert found.value == 8
    assert compare(table, ("CGP-Online", "SAC"), probability_of_improvement, "score", 10) is None


def test_cells_are_configurations(tmp_path: Path) -> None:
    configurations = [{"width": 32}, {"width": 64}, {"width": 128}]
    table = score_table([study(tmp_path, runs(lambda method, settings, seed: seed, ["TD3"], configurations))])
    assert [cell.tolist() for cell in cells_of(table, "score").values()] == [[0, 1, 2, 3]] * 3


def test_configurations_in_words() -> None:
    settings = {"learning_rate": 1e-4, "train_freq": [1, "step"], "noise_type": "normal", "use_sde": True}
    assert settings_in_words(settings) == "learning rate 0.0001, train freq [1, step], noise type normal, use sde true"
