"""Differences between methods, against formulas by hand."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from finished_studies import record, runs, study
from scipy.special import stdtrit
from tables import unpadded

from benchmark.common.records import Record
from benchmark.reporting.comparisons import (
    HIGHER,
    LOWER,
    NOT_DISTINGUISHABLE,
    TOO_FEW,
    difference_in_words,
    differences_table,
    experiments_section,
    improvement_table,
    pairs_of,
    pooled_rows,
)
from benchmark.reporting.estimates import Estimate, mean_of_differences
from benchmark.reporting.scores import score_table


def rows(table: str) -> dict[tuple[str, str], list[str]]:
    """Return the other cells of a table's rows, by the first two."""
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in unpadded(table).splitlines()]
    return {(first, second): rest for first, second, *rest in cells[2:]}


@pytest.mark.parametrize(("ours", "theirs"), [(4, 4), (3, 5), (2, 10)])
def test_interval_of_a_difference_is_welchs(ours: int, theirs: int) -> None:
    draw = np.random.default_rng(0)
    one, other = draw.normal(5, 1, ours), draw.normal(2, 4, theirs)
    found = mean_of_differences([(one, other)])
    squares = [float(np.sum((each - each.mean()) ** 2)) / (len(each) - 1) / len(each) for each in (one, other)]
    freedom = sum(squares) ** 2 / sum(square**2 / (len(each) - 1) for square, each in zip(squares, (one, other), strict=True))
    half = stdtrit(freedom, 0.975) * math.sqrt(sum(squares))
    assert found.value == pytest.approx(one.mean() - other.mean())
    assert found.interval == pytest.approx((found.value - half, found.value + half))
    assert found.runs == min(ours, theirs)


def test_interval_of_a_mean_over_tasks_is_welchs_and_satterthwaites() -> None:
    """With equal variances of tasks it is that of all runs' residuals, and a task without variance adds nothing to it."""
    draw = np.random.default_rng(0)
    one, other = draw.normal(5, 1, 4), draw.normal(2, 1, 4)
    single = mean_of_differences([(one, other)])
    alike = mean_of_differences([(one, other), (one - 2.0, other)])
    squares = [float(each.var(ddof=1)) / 4 / 4 for each in (one, other)] * 2
    half = stdtrit(sum(squares) ** 2 / sum(square**2 / 3 for square in squares), 0.975) * math.sqrt(sum(squares))
    assert alike.value == pytest.approx(single.value - 1.0)
    assert alike.interval == pytest.approx((alike.value - half, alike.value + half))
    assert alike.runs == 4
    constant = mean_of_differences([(one, other), (np.full(5, 3.0), np.full(6, 1.0))])
    assert single.interval is not None
    assert constant.interval is not None
    assert constant.interval == pytest.approx(tuple((bound + 2.0) / 2 for bound in single.interval))


def test_difference_without_variance_or_of_single_runs() -> None:
    assert mean_of_differences([(np.full(4, 3.0), np.full(4, 1.0))]).interval == (2.0, 2.0)
    assert mean_of_differences([(np.array([3.0]), np.array([1.0, 2.0]))]) == Estimate(1.5, None, 1)
    # One side alone without variance has the interval of the other
    found = mean_of_differences([(np.full(4, 3.0), np.array([0.0, 1.0, 2.0, 3.0]))])
    assert found.interval == pytest.approx((1.5 - 3.1824 * 0.6455, 1.5 + 3.1824 * 0.6455), abs=1e-3)


@pytest.mark.parametrize(
    ("interval", "number", "word"),
    [
        ((0.1, 2.0), 4, HIGHER),
        ((-2.0, -0.1), 4, LOWER),
        ((-0.1, 2.0), 4, NOT_DISTINGUISHABLE),
        ((0.1, 2.0), 3, TOO_FEW),
        (None, 1, TOO_FEW),
    ],
)
def test_words(interval: tuple[float, float] | None, number: int, word: str) -> None:
    assert difference_in_words(Estimate(1.0, interval, number)) == word


def probabilities(table: pd.DataFrame) -> dict[str, str]:
    """Return, by method, the probability that CGP improves on it, on the only task."""
    written = improvement_table(table, "CGP-Online", list(dict.fromkeys(table["method"])), 200)
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in unpadded(written).splitlines()]
    return {first: rest[0] for first, *rest in cells[2:] if rest}


def test_a_run_improves_only_on_runs_of_its_configuration(tmp_path: Path) -> None:
    """CGP is above TD3 in each configuration, by less than the configurations differ."""
    grid = [{"width": 32}, {"width": 64}]
    level = {("CGP-Online", 32): 10.0, ("TD3", 32): 7.5, ("CGP-Online", 64): 50.0, ("TD3", 64): 49.5}
    records = runs(lambda method, values, seed: level[method, values["width"]] + seed, ["CGP-Online", "TD3"], grid)
    found = probabilities(score_table([study(tmp_path, records)]))["TD3"]
    # Of 16 pairs, 15 are won with 32 units and 10 with 64
    assert float(found.split()[0]) == pytest.approx((15 / 16 + 10 / 16) / 2, abs=0.005)


def test_runs_that_do_not_overlap_have_no_interval_of_their_probability(tmp_path: Path) -> None:
    level = {"CGP-Online": 20.0, "TD3": 10.0, "SAC": 20.5}
    found = probabilities(score_table([study(tmp_path, runs(lambda method, _, seed: level[method] + seed, level))]))
    assert found["TD3"] == "1.00 (no interval)"
    assert " to " in found["SAC"]


def test_pairs() -> None:
    assert pairs_of(["CGP-Online", "TD3", "CGP-Light", "Random"]) == [
        ("CGP-Light", "CGP-Online"),
        ("CGP-Light", "TD3"),
        ("CGP-Online", "TD3"),
    ]
    assert pairs_of(["CGP-Online", "TD3"]) == [("CGP-Online", "TD3")]
    assert pairs_of(["CGP-Light", "TD3"]) == [("CGP-Light", "TD3")]
    # Of neither of this project's, the first one is compared
    assert pairs_of(["Random", "TD3", "SAC", "DDPG"]) == [("TD3", "SAC"), ("TD3", "DDPG")]
    assert pairs_of(["Random", "TD3"]) == pairs_of(["Random"]) == []


def test_differences_on_each_task_and_on_all_that_have_enough_runs(tmp_path: Path) -> None:
    level = {"CGP-Light": 100.0, "CGP-Online": 50.0, "TD3": 52.0}
    records = runs(lambda method, _, seed: level[method] + 4 * seed, level, tasks=("Hopper-v5", "Ant-v5", "Pusher-v5"))
    # On Ant, a tenth of the rewards; on Pusher, two seeds
    records = [run for run in records if run.task != "Pusher-v5" or run.seed < 2]
    records = [
        replace(run, final=float(run.final or 0) / 10, returns=[0.0] * len(run.timesteps)) if run.task == "Ant-v5" else run
        for run in records
    ]
    records.append(record("Random", 0, 12.0, "Hopper-v5", returns=[12.0]))
    chosen = study(tmp_path, records)
    found = rows(differences_table(score_table([chosen]), chosen.methods))
    # Standard error: sqrt(2 * (80 / 3) / 4); 6 degrees of freedom
    half = 2.4469 * math.sqrt(2 * 80 / 3 / 4)
    assert found["Hopper-v5", "CGP-Light − CGP-Online"] == [
        f"50.0 ({50 - half:.1f} to {50 + half:.1f})",
        HIGHER,
        "4 and 4",
    ]
    assert found["Ant-v5", "CGP-Online − TD3"][1] == NOT_DISTINGUISHABLE
    assert found["Pusher-v5", "CGP-Light − TD3"][1:] == [TOO_FEW, "2 and 2"]
    # The best reward is 112, or 11.2; the lowest return 12, or 0
    share, word, number = found["Hopper-v5, Ant-v5", "CGP-Light − CGP-Online"]
    assert float(share.split()[0]) == pytest.approx((50 / 100 + 5 / 11.2) / 2, abs=1e-3)
    assert (word, number) == (HIGHER, "8 and 8")
    assert found["Hopper-v5, Ant-v5", "CGP-Online − TD3"][1] == NOT_DISTINGUISHABLE
    assert not any("Random" in pair for _, pair in found)


def test_tasks_in_studies_of_their_own_are_compared_together(tmp_path: Path) -> None:
    """The rows are those of one study with all tasks, and an experiment of one study has none."""
    draw = np.random.default_rng(0)

    def of(task: str, experiment: str) -> list[Record]:
        return [
            replace(record(method, seed, float(draw.normal(mean, 1)), task=task), experiment=experiment)
            for method, mean in (("CGP-Online", 5.0), ("TD3", 2.0))
            for seed in range(4)
        ]

    pendulum, reacher = of("Pendulum-v1", "e1"), of("Reacher-v5", "e1")
    alone = study(tmp_path, of("Hopper-v5", "e10-quick"), "alone")
    first, second = study(tmp_path, pendulum, "first"), study(tmp_path, reacher, "second")
    for each in (first, second, alone):
        each.facts["experiment"] = each.records[0].experiment
    together = study(tmp_path, pendulum + reacher, "together")
    section = experiments_section([first, second, alone])
    assert "E1, the studies first, second:" in section
    assert "E10" not in section
    table = section[section.index("|") :]
    ((pair, found),) = rows(table).items()
    expected = rows(differences_table(score_table([together]), together.methods))[pair]
    assert pair == ("all tasks (2)", "CGP-Online − TD3")
    assert found[0].split()[0] == expected[0].split()[0]
    assert found[1:] == expected[1:] == [HIGHER, "8 and 8"]
    assert experiments_section([first]) == experiments_section([alone]) == ""
    # A study of which no row has a run is not named
    few = study(tmp_path, [record("TD3", 0, 1.0, task="Ant-v5")], "few")
    few.facts["experiment"] = "e1"
    assert "E1, the studies first, second:" in experiments_section([first, few, second])


def test_all_tasks_are_those_on_which_both_were_compared(tmp_path: Path) -> None:
    """A task that one study ran with the first method, and another study with the second, is none of them."""
    pair, both = ["CGP-Online", "TD3"], ["Hopper-v5", "Ant-v5"]

    def scored(methods: list[str], tasks: list[str]) -> list[Record]:
        return runs(lambda method, _, seed: float(seed + 3 * (method == "TD3")), methods, tasks=tasks)

    one = study(tmp_path, [*scored(pair, both), *scored(["CGP-Online"], ["Pusher-v5"])], "one")
    other = study(tmp_path, scored(["TD3"], ["Pusher-v5"]), "other")
    ((name, _, *found),) = pooled_rows(score_table([one, other]), pair)
    assert (name, found[-1]) == ("Hopper-v5, Ant-v5", "8 and 8")
    ((_, _, *expected),) = pooled_rows(score_table([study(tmp_path, scored(pair, both), "both")]), pair)
    assert found == expected


def test_experiments_of_users_are_not_taken_together_by_their_names_beginning(tmp_path: Path) -> None:
    studies = []
    for name, task in (("my-walker", "Walker2d-v5"), ("my-arm", "Reacher-v5")):
        records = runs(lambda method, _, seed: float(seed + 3 * (method == "TD3")), ["CGP-Online", "TD3"], tasks=[task])
        studies.append(study(tmp_path, [replace(run, experiment=name) for run in records], name))
    assert experiments_section(studies) == ""
    for each in studies:
        each.facts["experiment"] = "my-robots"
    assert "my-robots, the studies my-walker, my-arm:" in experiments_section(studies)


def test_one_task_is_not_all_tasks(tmp_path: Path) -> None:
    chosen = study(tmp_path, runs(lambda method, _, seed: float(seed), ["CGP-Light", "TD3"]))
    assert list(rows(differences_table(score_table([chosen]), chosen.methods))) == [("Pendulum-v1", "CGP-Light − TD3")]
    assert differences_table(score_table([chosen]), ["TD3", "SAC"]) == ""
