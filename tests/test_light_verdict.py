"""The answer on what the light setting loses, and which runs it counts."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from finished_studies import record, runs, study
from tables import unpadded

from benchmark.reporting.light import light_section
from benchmark.reporting.scores import Study, score_table
from benchmark.reporting.side_runs import without_side_runs

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
