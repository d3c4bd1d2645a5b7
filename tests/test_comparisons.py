"""Differences between methods against formulas by hand, and the answer on what the light setting loses."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from finished_studies import record, runs, write_study
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
from benchmark.reporting.light import light_section
from benchmark.reporting.scores import Study, read_study, score_table
from benchmark.reporting.side_runs import without_side_runs


def study(folder: Path, records: list[Record], name: str = "sweep") -> Study:
    return read_study(write_study(folder / name, records))


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


def test_intervals_of_four_runs_hold_the_truth_about_as_often_as_the_page_says() -> None:
    draw = np.random.default_rng(1)
    held = []
    for _ in range(400):
        found = mean_of_differences([(draw.normal(1, 1, 4), draw.normal(0, 1, 4))])
        assert found.interval is not None
        held.append(found.interval[0] <= 1 <= found.interval[1])
    assert 0.93 <= np.mean(held) <= 0.98


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
    records = [
        replace(run, final=run.final / 10, returns=[0.0]) if run.task == "Ant-v5" and run.final is not None else run
        for run in records
        if run.task != "Pusher-v5" or run.seed < 2
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


NO_LOSS = "No loss of more than 5% of a task's range"


def compared(folder: Path, light: dict[str, float], seeds: int = 4, spread: float = 1.0) -> str:
    """
    Write a study in which the paper's setting scores 50 on each task, in a range from 0 to 100, and the light one so.

    Scores grow by ``spread`` with the seed.
    """
    tasks = list(light)
    records = runs(lambda *run: 50.0 + spread * run[2], ["CGP-Online"], seeds=range(seeds), tasks=tasks)
    records += [record("CGP-Light", seed, light[task] + spread * seed, task) for task in tasks for seed in range(seeds)]
    records += [record("TD3", 0, 100.0, task, returns=[0.0]) for task in tasks]
    return unpadded(light_section([study(folder, records)]))


def test_losses_are_named_with_their_tasks(tmp_path: Path) -> None:
    text = compared(tmp_path, {"Hopper-v5": 20.0, "Ant-v5": 80.0, "Pusher-v5": 50.0})
    half = 2.4469 * math.sqrt(2 * 5 / 3 / 4)
    assert (
        f"**Yes, on Hopper-v5 (sweep, 1,000 steps) by 30.00 ({30 - half:.2f} to {30 + half:.2f}), 30% of the task's range.**"
        in text
    )
    assert "CGP-Light is higher on Ant-v5 (sweep, 1,000 steps)." in text
    assert "not distinguishable on Pusher-v5 (sweep, 1,000 steps), which is no proof" in text
    assert f"losses of up to {half:.0f}% of a task's range, on Pusher-v5" in text
    assert f"| Hopper-v5 (sweep, 1,000 steps) | -30.00 ({-30 - half:.2f} to {-30 + half:.2f}) | lower |" in text
    assert "| higher | 0.00 (0%) | 4 |" in text
    # In returns, too
    assert f"| lower | {30 + half:.2f} ({30 + half:.0f}%) | 4 |" in text


@pytest.mark.parametrize(
    ("light", "answer", "higher"),
    [
        # The interval reaches 4.47 to both sides: the largest losses in it are 4.47, 4.97 and 5.07 % of the range
        ({"Hopper-v5": 50.0}, NO_LOSS, 0),
        ({"Hopper-v5": 49.5}, NO_LOSS, 0),
        ({"Hopper-v5": 49.4}, "Not decided", 0),
        ({"Hopper-v5": 49.5, "Ant-v5": 70.0}, NO_LOSS, 1),
        ({"Hopper-v5": 49.4, "Ant-v5": 70.0}, "Not decided", 1),
    ],
)
def test_there_is_no_loss_if_no_interval_has_one_that_counts(
    light: dict[str, float], answer: str, higher: int, tmp_path: Path
) -> None:
    counted = f"CGP-Light is higher on {higher}, lower on none, and not distinguishable on 1."
    assert f"**{answer}: of {len(light)} tasks, {counted}**" in compared(tmp_path, light, spread=2.0)


def test_each_experiment_has_its_own_answer(tmp_path: Path) -> None:
    studies = []
    for name, light in [("e1", 50.0), ("e10-quick", 20.0)]:
        records = [replace(record("TD3", 0, 100.0, returns=[0.0]), experiment=name)]
        for method, value in [("CGP-Online", 50.0), ("CGP-Light", light)]:
            records += [replace(record(method, seed, value + seed), experiment=name) for seed in range(4)]
        studies.append(study(tmp_path, records, name))
        studies[-1].facts["experiment"] = name
    text = unpadded(light_section(studies))
    assert f"In E1: **{NO_LOSS}: of 1 tasks" in text
    assert "In E10: **Yes, on Pendulum-v1 (e10-quick, 1,000 steps) by 30.00" in text
    assert text.count("| Pendulum-v1 (e1, 1,000 steps) |") == text.count("| Pendulum-v1 (e10-quick, 1,000 steps) |") == 1


def test_no_loss_is_known(tmp_path: Path) -> None:
    text = compared(tmp_path / "few", {"Hopper-v5": 10.0}, seeds=3)
    assert "**Not known yet: on no task have 4 seeds of both methods ended.**" in text
    assert "Too few seeds have ended on Hopper-v5" in text


def with_failures(folder: Path, crashed: dict[str, int], returns: list[float]) -> str:
    """Write a study whose runs score 50 in a range from 0, but for those that failed after these returns."""
    records = [record("TD3", 0, 1.0, returns=[0.0])]
    for method, failures in crashed.items():
        records += [record(method, seed, None, returns=returns) for seed in range(failures)]
        records += [record(method, seed, 50.0 + seed) for seed in range(failures, 5)]
    return unpadded(light_section([study(folder, records)]))


def test_failed_runs_are_counted_beside_the_answer(tmp_path: Path) -> None:
    text = with_failures(tmp_path / "some", {"CGP-Light": 2, "CGP-Online": 0}, [10.0])
    assert "**Runs failed:** 2 of CGP-Light and 0 of CGP-Online on Pendulum-v1 (sweep, 1,000 steps); they count with" in text
    # The interval of three runs at 50 and two at 0 reaches below the task's range, whose best is that of Online's last run
    assert "(-56.22 to 15.82) | not distinguishable | 56.22 (100%) | 5 |" in text
    assert "failed" not in with_failures(tmp_path / "none", {"CGP-Light": 0, "CGP-Online": 0}, [])


def test_nothing_is_concluded_where_all_runs_failed(tmp_path: Path) -> None:
    failing = runs(lambda *_: None, ["CGP-Light", "CGP-Online"])
    text = light_section([study(tmp_path, failing)])
    assert "**Not known yet" in text
    assert "No runs of both have ended, or all have failed, on Pendulum-v1 (sweep, 1,000 steps)." in text
    half = [*failing[:4], *runs(lambda *run: 50.0 + run[2], ["CGP-Online"])]
    assert "**Yes, on Pendulum-v1" in light_section([study(tmp_path, half)])


@pytest.mark.parametrize(("loss", "percent"), [(0.04, "below 0.1%"), (0.5, "0.5%"), (5.0, "5%")])
def test_a_small_loss_is_given_as_a_share_of_the_range(loss: float, percent: str, tmp_path: Path) -> None:
    records = [record("TD3", 0, 100.0, returns=[0.0])]
    records += [record("CGP-Online", seed, 50.0) for seed in range(4)]
    records += [record("CGP-Light", seed, 50.0 - loss) for seed in range(4)]
    text = unpadded(light_section([study(tmp_path, records)]))
    assert f"), {percent} of the task's range.**" in text
    assert f"| lower | {loss:.2f} ({percent}) | 4 |" in text


def test_tasks_that_one_of_them_lacks_and_studies_that_do_not_compare_them(tmp_path: Path) -> None:
    both = runs(lambda *_: 1.0, ["CGP-Light", "CGP-Online"], tasks=["Hopper-v5"])
    unfinished = study(tmp_path, [*both, *runs(lambda *_: 1.0, ["CGP-Light"], tasks=["Ant-v5"])], "unfinished")
    text = light_section([unfinished])
    assert "**Not decided: of 2 tasks, CGP-Light is higher on 0, lower on none, and not distinguishable on 1.**" in text
    assert "No runs of both have ended, or all have failed, on Ant-v5 (unfinished, 1,000 steps)." in text
    swept = runs(lambda *_: 1.0, ["CGP-Light", "CGP-Online"], [{"width": 32}, {"width": 64}])
    assert light_section([study(tmp_path, swept, "swept")]) == ""
    assert light_section([study(tmp_path, runs(lambda *_: 1.0, ["CGP-Light", "TD3"]), "without")]) == ""


def test_longer_runs_replace_shorter_ones_only_if_they_have_all_their_methods(tmp_path: Path) -> None:
    def of(methods: list[str], steps: int) -> Study:
        records = [record(method, 0, 1.0, steps=steps) for method in methods]
        return study(tmp_path, records, f"{steps}")

    trial, whole, long = of(["TD3", "SAC"], 250), of(["CGP-Light", "SAC", "TD3"], 500), of(["CGP-Light", "TD3"], 1_000)
    assert [kept.name for kept in without_side_runs([trial, whole, long])] == ["500", "1000"]
    assert isinstance(score_table(without_side_runs([trial, whole, long])), pd.DataFrame)


@pytest.mark.parametrize(("seeds", "replaced"), [(1, False), (3, False), (4, True), (5, True)])
def test_longer_runs_replace_shorter_ones_only_if_they_are_enough(seeds: int, replaced: bool, tmp_path: Path) -> None:
    """Five runs of each method on two tasks, and a longer study of one of the tasks."""

    def of(name: str, tasks: list[str], seeds: int, steps: int) -> Study:
        pairs = [(method, task) for method in ("CGP-Online", "CGP-Light") for task in tasks]
        records = [record(method, seed, 50.0 + seed, task, steps=steps) for method, task in pairs for seed in range(seeds)]
        return study(tmp_path, records, name)

    short, long = of("short", ["Hopper-v5", "Ant-v5"], 5, 500), of("long", ["Hopper-v5"], seeds, 1_000)
    kept = without_side_runs([short, long])
    assert kept[0].tasks == (["Ant-v5"] if replaced else ["Hopper-v5", "Ant-v5"])
    # What is left out is not missing
    assert "No runs of both have ended" not in light_section(kept)


@pytest.mark.parametrize(
    ("methods", "changed", "kept"),
    [
        (["CGP-Light"], {"policy_delay": 2}, False),
        # The same hyperparameters: further runs of the same experiment
        (["CGP-Light"], {}, True),
        # None of them is a part of the other
        (["CGP-Light", "TD3"], {"policy_delay": 2}, True),
    ],
)
def test_a_variation_of_some_methods_does_not_count_as_the_experiment(
    tmp_path: Path, methods: list[str], changed: dict[str, Any], kept: bool
) -> None:
    def of(name: str, chosen: list[str], value: float, further: dict[str, Any]) -> Study:
        whole = study(tmp_path, runs(lambda *_: value, chosen, seeds=range(4)), name)
        whole.facts["configurations"] = {method: {"batch_size": 128, **further} for method in chosen}
        return whole

    main = of("main", ["CGP-Light", "TD3"], 1.0, {})
    variation = of("variation", methods, 0.0, changed)
    for order in ([main, variation], [variation, main]):
        found = without_side_runs(order)
        assert {each.name for each in found} == {"main", "variation"} if kept else {"main"}
        assert sorted(score_table(found)["score"].unique()) == ([0.0, 1.0] if kept else [1.0])
