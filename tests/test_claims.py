"""The verdicts on the paper's claims, on runs whose truth is known."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from finished_studies import record, runs, write_study
from tables import unpadded

from benchmark.common.records import Record
from benchmark.reporting.claims import best_or_second, equal_variants, findings
from benchmark.reporting.figures import figures
from benchmark.reporting.scores import read_study, score_table
from benchmark.reporting.verdicts import CONTRADICTED, NO_DATA, NOT_DECIDED, SUPPORTED, TOO_FEW, Finding

SWEPT = [{"width": 32}, {"width": 64}]
VARIANTS = ["CGP-Online", "CGP-Offline", "QGP-Online", "QGP-Offline"]


@pytest.fixture
def find(tmp_path: Path) -> Any:
    """Test a claim, named by a part of its text, on runs, and on a random one from 0 to 100, so that rewards are percents."""

    def finding(part: str, records: list[Record], runtime: dict[str, Any] | None = None) -> Finding:
        scale = [record("Random", 99, 100.0, task, returns=[0.0]) for task in {run.task for run in records}]
        table = score_table([read_study(write_study(tmp_path / "sweep", records + scale))])
        (found,) = (each for each in findings(table, runtime, repetitions=200) if part in each.claim)
        return found

    return finding


def text_of(found: Finding) -> str:
    """The text of all parts."""
    return "; ".join(part.whole_text for part in found.parts)


def scores(**levels: float) -> Any:
    """Score each method at its level, seeds one apart."""
    by_name = {name.replace("_", "-"): level for name, level in levels.items()}
    return lambda method, settings, seed: by_name[method] + seed


def test_nothing_is_said_without_data(tmp_path: Path) -> None:
    table = score_table([read_study(write_study(tmp_path / "sweep", []))])
    assert isinstance(table, pd.DataFrame)
    found = findings(table, None, repetitions=10)
    assert len(found) == 9
    assert {each.verdict for each in found} == {NO_DATA}
    assert [each.parts for each in found] == [[]] * 9


def test_foreign_methods_alone_say_nothing(find: Any) -> None:
    records = runs(scores(PPO=50, A2C=40), ["PPO", "A2C"])
    assert find("best or second", records).verdict == NO_DATA


@pytest.mark.parametrize(
    ("levels", "verdict"),
    [
        (dict(CGP_Online=80, TD3=40, SAC=90, DDPG=20), SUPPORTED),
        (dict(CGP_Online=30, TD3=40, SAC=90, DDPG=20), CONTRADICTED),
        (dict(CGP_Online=40, TD3=40, SAC=90, DDPG=20), NOT_DECIDED),
    ],
)
def test_best_or_second(find: Any, levels: dict[str, float], verdict: str) -> None:
    methods = [name.replace("_", "-") for name in levels]
    found = find("best or second", runs(scores(**levels), methods))
    assert found.verdict == verdict


def test_best_or_second_must_hold_on_every_task(find: Any) -> None:
    methods = ["CGP-Online", "TD3", "SAC"]
    good = runs(scores(CGP_Online=80, TD3=40, SAC=20), methods, tasks=["Pendulum-v1"])
    bad = runs(scores(CGP_Online=20, TD3=40, SAC=80), methods, tasks=["Reacher-v5"])
    found = find("best or second", good + bad)
    assert found.verdict == CONTRADICTED
    assert "1 of 3 on Pendulum-v1" in text_of(found)
    assert "3 of 3 on Reacher-v5" in text_of(found)


def test_second_best_by_little_on_many_tasks_is_not_contradicted(find: Any) -> None:
    """The lowest of several leads is lower than each of them is by itself."""
    level = {"CGP-Online": 50.0, "SAC": 60.0, "TD3": 49.0, "DDPG": 30.0}
    draw = np.random.default_rng(0)
    tasks = ["Pendulum-v1", "Reacher-v5", "Hopper-v5", "Ant-v5", "Swimmer-v5"]
    records = runs(lambda method, _, seed: level[method] + draw.normal(scale=2.0), level, tasks=tasks)
    found = find("best or second", records)
    assert len(found.parts) == len(tasks)
    assert found.verdict == NOT_DECIDED


@pytest.mark.parametrize(("level", "verdict"), [(80, NOT_DECIDED), (20, CONTRADICTED)])
def test_an_unfinished_task_has_no_rank_and_is_not_counted(find: Any, level: float, verdict: str) -> None:
    """It comes first in the study, and would be the evidence."""
    methods = ["CGP-Online", "TD3", "SAC"]
    unfinished = runs(scores(CGP_Online=20, TD3=40, SAC=80), methods, tasks=["Ant-v5"], seeds=range(3))
    whole = runs(scores(CGP_Online=level, TD3=40, SAC=50), methods, tasks=["Pendulum-v1", "Reacher-v5"])
    found = find("best or second", unfinished + whole)
    assert [part.verdict for part in found.parts] == [SUPPORTED if level == 80 else CONTRADICTED] * 2 + [TOO_FEW]
    assert found.verdict == verdict
    text = "Ant-v5, of which only 3 of CGP-Online, 3 of SAC, 3 of TD3 have ended"
    assert found.parts[-1].text == text
    counted = f"rank 3 of 3 on Pendulum-v1, higher than 0 and lower than 2 of 2 rivals; {CONTRADICTED} in 2 of 2 comparisons"
    assert found.evidence == (text if level == 80 else counted)


def test_ranks_are_within_a_study(tmp_path: Path) -> None:
    """Two studies on one task, each with the second rival that the other lacks."""
    first = runs(scores(CGP_Online=30, TD3=40), ["CGP-Online", "TD3"])
    second = runs(scores(CGP_Online=60, SAC=40, DDPG=20), ["CGP-Online", "SAC", "DDPG"])
    studies = [read_study(write_study(tmp_path / name, each)) for name, each in (("one", first), ("two", second))]
    (found,) = (each for each in findings(score_table(studies), None, 200) if "best or second" in each.claim)
    assert found.verdict == SUPPORTED
    assert len(found.parts) == 1
    assert "rank 1 of 3" in text_of(found)


def test_equal_methods_are_not_told_apart_by_chance(tmp_path: Path) -> None:
    """The second best of several rivals is lower than its mean by chance, and the range of three means is positive."""
    draw, n_studies = np.random.default_rng(0), 60

    def table(methods: list[str], n_settings: int, seeds: int) -> pd.DataFrame:
        level = draw.normal(60, 15, n_settings)
        settings = [{"width": width} for width in range(n_settings)] if n_settings > 1 else [{}]
        drawn = runs(
            lambda _, chosen, seed: float(np.clip(draw.normal(level[chosen.get("width", 0)], 15), 0, 100)),
            methods,
            settings,
            range(seeds),
        )
        scale = record("Random", 99, 100.0, returns=[0.0], settings=settings[0])
        return score_table([read_study(write_study(tmp_path / "sweep", [*drawn, scale]))])

    ranks = [best_or_second(table(["CGP-Online", "TD3", "SAC"], 1, 4)) for _ in range(n_studies)]
    # Of the three, as the fourth is said to be lower
    gaps = [equal_variants(table(VARIANTS, 8, 4), 100)[:3] for _ in range(n_studies)]
    assert [Finding("", each).verdict for each in ranks].count(SUPPORTED) <= 0.07 * n_studies
    assert [Finding("", each).verdict for each in gaps].count(CONTRADICTED) <= 0.07 * n_studies


def test_own_variants_and_random_actions_are_no_rivals(find: Any) -> None:
    levels = dict(CGP_Online=60, CGP_Offline=90, QGP_Online=80, CGP_Light=95, CEM=85, TD3=50, SAC=40, Random=99)
    found = find("best or second", runs(scores(**levels), [name.replace("_", "-") for name in levels]))
    assert found.verdict == SUPPORTED
    assert "rank 1 of 3" in text_of(found)


@pytest.mark.parametrize(("ours", "theirs", "verdict"), [(1, 20, SUPPORTED), (20, 1, CONTRADICTED), (5, 5, NOT_DECIDED)])
def test_narrower_spread(find: Any, ours: float, theirs: float, verdict: str) -> None:
    width = {"CGP-Online": ours, "TD3": theirs, "SAC": theirs}
    records = runs(lambda method, _, seed: 50 + width[method] * (seed - 3.5) / 3.5, width, SWEPT, seeds=range(8))
    found = find("narrower", records)
    assert found.verdict == verdict
    assert "TD3" in text_of(found)
    assert "SAC" in text_of(found)
    assert "DDPG" not in text_of(found)


def test_one_wider_baseline_is_not_enough(find: Any) -> None:
    width = {"CGP-Online": 3.0, "TD3": 10.0, "SAC": 0.1}
    found = find("narrower", runs(lambda method, _, seed: 10 + width[method] * seed, width, SWEPT, seeds=range(9)))
    assert [part.verdict for part in found.parts] == [SUPPORTED, CONTRADICTED]
    assert found.verdict == CONTRADICTED


def test_high_learning_rates_are_left_out_of_the_spread(find: Any) -> None:
    rates = [{"learning_rate": rate} for rate in (1e-4, 1e-3, 1e-2, 3e-2)]

    def score(method: str, settings: dict[str, Any], seed: int) -> float:
        if method == "CGP-Online":
            return 80.0 + seed if settings["learning_rate"] < 1e-2 else 0.0
        return 50.0 + 10 * seed

    found = find("narrower", runs(score, ["CGP-Online", "TD3"], rates))
    assert found.verdict == SUPPORTED
    assert "learning rates from 0.01 on included" in text_of(found)


@pytest.mark.parametrize(("ours", "verdict"), [(80.0, SUPPORTED), (60.0, SUPPORTED), (30.0, CONTRADICTED)])
def test_actor_against_cem(find: Any, ours: float, verdict: str) -> None:
    assert find("imitates", runs(scores(CGP_Online=ours, CEM=60), ["CGP-Online", "CEM"])).verdict == verdict


@pytest.mark.parametrize(("factor", "verdict"), [(1.0, SUPPORTED), (1.5, CONTRADICTED), (0.5, CONTRADICTED)])
def test_inference_cost(find: Any, factor: float, verdict: str) -> None:
    # Rounds differ far more than methods within a round
    rounds = np.array([1.0, 3.0, 2.0, 1.5, 2.5, 8.0])
    timed = {"CGP-2": rounds, "CGP-4": factor * rounds, "CEM-2": 3 * rounds, "CEM-4": 6 * rounds, "CGP-2-plain": rounds}
    runtime = {"methods": {name: {"inference": {"seconds": {"all": list(all_)}}} for name, all_ in timed.items()}}
    runtime["methods"]["SBX"] = {"missing": "not installed"}
    found = find("inference cost", [], runtime)
    assert found.verdict == verdict
    assert f"after 4 iterations takes {factor:.2f}" in text_of(found)
    assert "CEM itself 2.00 times" in text_of(found)


@pytest.mark.parametrize(
    ("axis", "values", "claim"),
    [("learning_rate", (1e-2, 1e-3, 1e-4), "learning rate of 0.01"), ("learning_starts", (0, 1_000, 10_000), "few initial")],
)
@pytest.mark.parametrize(("poor", "verdict"), [(10.0, SUPPORTED), (78.0, CONTRADICTED)])
def test_failing_settings(find: Any, axis: str, values: tuple[float, ...], claim: str, poor: float, verdict: str) -> None:
    bad = {1e-2, 0, 1_000}

    def score(method: str, settings: dict[str, Any], seed: int) -> float:
        return (poor if settings[axis] in bad else 80.0) + seed

    found = find(claim, runs(score, ["CGP-Online", "TD3"], [{axis: value} for value in values]))
    assert found.verdict == verdict
    assert ("0 of" in text_of(found)) == (verdict == CONTRADICTED)


def test_named_values_of_an_axis_are_no_numbers(find: Any) -> None:
    found = find("few initial", runs(lambda *_: 1.0, ["CGP-Online"], [{"learning_starts": name} for name in ("few", "many")]))
    assert found.verdict == NO_DATA


@pytest.mark.parametrize(("high", "verdict"), [(60.0, SUPPORTED), (95.0, CONTRADICTED)])
def test_a_high_rate_is_compared_with_the_best_other_where_all_else_is_equal(find: Any, high: float, verdict: str) -> None:
    """Neither does a rate that is too low make a high one look good, nor a batch that only one of them was run with."""
    level = {1e-2: high, 1e-3: 100.0, 1e-4: 20.0}
    grid = [{"learning_rate": rate, "batch_size": size} for rate in level for size in (32, 64)]
    grid.remove({"learning_rate": 1e-2, "batch_size": 32})

    def score(method: str, settings: dict[str, Any], seed: int) -> float:
        return 0.0 if settings["batch_size"] == 32 else level[settings["learning_rate"]] - 0.2 * seed

    found = find("learning rate of 0.01", runs(score, ["CGP-Online", "TD3"], grid))
    assert found.verdict == verdict
    assert f"mean {(high - 0.3) / 100:.3f} with 0.01, 0.997 with 0.001" in text_of(found)


def test_crashes_at_a_high_rate_count(find: Any) -> None:
    def score(method: str, settings: dict[str, Any], seed: int) -> float | None:
        return None if settings["learning_rate"] == 1e-2 else 80.0 + seed

    records = runs(score, ["CGP-Online"], [{"learning_rate": rate} for rate in (1e-2, 1e-3)])
    assert find("learning rate of 0.01", records).verdict == SUPPORTED


def test_schedules_are_no_high_rates(find: Any) -> None:
    records = runs(scores(CGP_Online=50), ["CGP-Online"], [{"learning_rate": "lin_1e-2"}, {"learning_rate": 1e-3}])
    assert find("learning rate of 0.01", records).verdict == NO_DATA


def test_variants(find: Any) -> None:
    good, poor = [80.0] * 12, [20.0] * 3 + [80.0] * 9
    tables = {"CGP-Online": good, "CGP-Offline": poor, "QGP-Online": poor, "QGP-Offline": [20.0] * 12}
    records = runs(lambda method, _, seed: tables[method][seed] + 0.1 * seed, VARIANTS, SWEPT, seeds=range(12))
    assert find("upper quartiles", records).verdict == SUPPORTED
    assert find("bottom quartile", records).verdict == SUPPORTED

    tables |= {"CGP-Online": poor, "QGP-Online": good, "CGP-Offline": [40.0] * 12}
    records = runs(lambda method, _, seed: tables[method][seed] + 0.1 * seed, VARIANTS, SWEPT, seeds=range(12))
    assert find("upper quartiles", records).verdict == CONTRADICTED
    assert find("bottom quartile", records).verdict == CONTRADICTED


@pytest.mark.parametrize(
    ("fourth", "verdict"), [(60.0, SUPPORTED), (79.0, CONTRADICTED), (80.0, CONTRADICTED), (95.0, CONTRADICTED)]
)
def test_three_of_four_variants_are_equal_if_the_fourth_is_lower_by_more_than_counts_as_equal(
    find: Any, fourth: float, verdict: str
) -> None:
    levels = dict.fromkeys(VARIANTS, 80.0) | {"QGP-Offline": fourth}
    records = runs(lambda method, _, seed: levels[method] + 0.1 * seed, VARIANTS, SWEPT, seeds=range(12))
    found = find("upper quartiles", records)
    assert found.verdict == verdict
    assert [part.verdict for part in found.parts] == [SUPPORTED] * 3 + [verdict] * 3
    # What counts as none, in returns
    assert {part.note for part in found.parts} == {"0.05 of the range is 5.00 on Pendulum-v1"}


@pytest.mark.parametrize(
    ("levels", "verdict"),
    [
        (dict(CGP_Online=60, CGP_Offline=50, QGP_Online=55, QGP_Offline=40), SUPPORTED),
        (dict(CGP_Online=60, CGP_Offline=50, QGP_Online=40, QGP_Offline=55), CONTRADICTED),
        (dict(CGP_Online=60, CGP_Offline=50, QGP_Online=40, QGP_Offline=40), NOT_DECIDED),
    ],
)
def test_online_against_offline(find: Any, levels: dict[str, float], verdict: str) -> None:
    assert find("online training", runs(scores(**levels), VARIANTS)).verdict == verdict


def test_evidence_of_imitation_and_of_offline_training_names_its_statistic_and_the_sign(find: Any) -> None:
    """The interquartile mean of CGP-Offline is the higher one, by 10.5, and its mean is the lower one."""
    online = [50.0, 50.0, 50.0, 50.0]
    offline = [0.0, 60.5, 60.5, 61.0]
    by_name = {"CGP-Online": online, "CGP-Offline": offline, "CEM": offline}
    records = runs(lambda method, _, seed: by_name[method][seed], by_name)
    (part,) = find("online training", records).parts
    assert part.text.startswith("interquartile mean of CGP-Online 0.500, of CGP-Offline 0.605: lower by 0.105 (")
    (part,) = find("imitates", records).parts
    assert part.text.startswith("interquartile mean of CGP-Online 0.500, of CEM 0.605: lower by 0.105 (")


def test_a_small_difference_is_not_rounded_to_none(find: Any) -> None:
    """The verdict on a spread may rest on a bound below 0.001."""
    width = {"CGP-Online": 0.12, "TD3": 0.02}
    found = find("narrower", runs(lambda method, _, seed: 50 + width[method] * seed, width, SWEPT, seeds=range(9)))
    assert found.verdict == CONTRADICTED
    assert text_of(found).startswith("range 0.0048 against TD3's 0.0008: wider by 0.0040 (0.00")
    assert "(0.000 " not in text_of(found)


def test_nothing_is_said_where_nothing_was_learnt(find: Any, tmp_path: Path) -> None:
    """All runs return the same, as those of a sparse reward."""
    rates = [{"learning rate": rate} for rate in (0.01, 0.001)]
    families = ["CGP-Online", "CGP-Offline", "QGP-Online", "QGP-Offline", "CEM", "TD3", "SAC", "DDPG"]
    constant = [replace(run, returns=[-50.0] * len(run.returns)) for run in runs(lambda *_: -50.0, families, rates)]
    table = score_table([read_study(write_study(tmp_path / "sweep", constant))])
    assert {finding.verdict for finding in findings(table, None, 50)} == {NO_DATA}


@pytest.mark.parametrize("seeds", [1, 2, 3])
def test_few_seeds_decide_nothing(find: Any, seeds: int) -> None:
    records = runs(scores(CGP_Online=80, CEM=10), ["CGP-Online", "CEM"], seeds=range(seeds))
    found = find("imitates", records)
    assert found.verdict == NOT_DECIDED
    assert "no interval" in text_of(found)


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("name", ["mine", "experiment-1", "e10", "e10-mine"])
def test_only_the_papers_experiments_are_judged(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Neither a user's own study nor E10 changes a verdict on a page with the paper's, and alone they have none."""
    methods = ["CGP-Online", "CEM", "TD3", "SAC"]
    papers = write_study(tmp_path / "e1", runs(scores(CGP_Online=80, CEM=50, TD3=40, SAC=30), methods))
    opposite = runs(scores(CGP_Online=0, CEM=900, TD3=800, SAC=700), methods)
    other = write_study(tmp_path / name, [replace(run, experiment=name) for run in opposite])

    def page(*folders: Path) -> str:
        return figures(folders, tmp_path, 50).read_text()

    def claims(text: str) -> str:
        return text[text.index("## The paper's claims") : text.index("## Findings by task")]

    alone = page(papers)
    assert "supported" in claims(alone)
    assert claims(page(papers, other)) == claims(alone)
    assert f"Drawing the figures of e1, {name} into {tmp_path}/figures" in capsys.readouterr().err
    text = page(other)
    for part in ("claims", "Figure numbers in headings are the paper's", "benchmark.runtime"):
        assert part in alone
        assert part not in text


def test_the_time_of_inference_is_that_measured_beside_the_page(tmp_path: Path) -> None:
    """The record of ``benchmark.runtime`` in the repository is of other machines than a user's."""
    own = write_study(tmp_path / "sweeps/e1", runs(scores(CGP_Online=50, CEM=20), ["CGP-Online", "CEM"]))

    def claim() -> str:
        text = unpadded(figures([own], tmp_path / "sweeps", 10).read_text())
        (row,) = (line for line in text.splitlines() if "inference cost is independent" in line)
        return row

    assert "no data" in claim()
    times = {"CGP-2": [1.0] * 4, "CGP-4": [1.0] * 4}
    record = {"methods": {name: {"inference": {"seconds": {"all": seconds}}} for name, seconds in times.items()}}
    (tmp_path / "runtime").mkdir()
    (tmp_path / "runtime/runtime.json").write_text(json.dumps(record))
    assert "takes 1.00 (1.00 to 1.00) times as long" in claim()
