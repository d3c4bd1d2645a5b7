"""Copies of one run count once, in a study and in several, and are drawn together."""

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from finished_studies import record, runs, study
from tables import unpadded

from benchmark.common.records import configuration_in_words
from benchmark.reporting.claims import online_better
from benchmark.reporting.comparisons import improvement_table, pooled_rows
from benchmark.reporting.copies import without_copies
from benchmark.reporting.estimates import cells_of, compare, estimate, interquartile_mean, probability_of_improvement
from benchmark.reporting.page import introduction
from benchmark.reporting.scores import Study, score_table
from benchmark.reporting.sections import reward_tables

SAMPLES = [{"samples": number} for number in (16, 64, 256)]
FINALS = np.random.default_rng(6).normal(size=8)


def trained(
    folder: Path, name: str, entries: dict[str, dict[str, Any]], settings: Any = ({},), seeds: Any = range(4)
) -> Study:
    """A study of methods that have the same hyperparameters in all configurations, and score by their seed alone."""
    records = runs(lambda method, _, seed: FINALS[seed], entries, settings, seeds)
    configurations = {configuration_in_words(run.method, run.settings): entries[run.method] for run in records}
    return study(folder, records, name, configurations=configurations)


def test_configurations_with_the_same_hyperparameters_count_once(tmp_path: Path) -> None:
    several, one = (trained(tmp_path, f"s{n}", {"TQC": {"algo": "tqc"}}, SAMPLES[:n]) for n in (3, 1))
    found, expected = (estimate(interquartile_mean, [cells_of(score_table([each]), "score")], 200) for each in (several, one))
    assert found == expected
    assert found.runs == 4
    assert "| 4 | 0 |" in unpadded(reward_tables(score_table([several]), several, 20)[0])
    assert introduction([several]).startswith(
        "The final returns and learning curves of 12 training runs. 8 of them are copies"
    )
    assert introduction([one]).endswith("of 4 training runs.")


@pytest.mark.parametrize(
    ("other", "is_copy"),
    [
        ({"algo": "td3", "gamma": 0.9}, True),
        ({"gamma": 0.9, "algo": "td3", "train_freq": [1, "step"], "gradient_steps": 1, "policy_kwargs": None}, True),
        ({"algo": "td3", "gamma": 0.9, "train_freq": [1, "episode"]}, False),
        ({"algo": "td3"}, False),
        ({"algo": "ddpg", "gamma": 0.9}, False),
        ({"algo": "mine", "gamma": 0.9}, False),
    ],
)
def test_runs_of_several_studies_count_once(tmp_path: Path, other: dict[str, Any], is_copy: bool) -> None:
    """... also where one of them names what is the algorithm's default."""
    first = trained(tmp_path, "first", {"TD3": {"algo": "td3", "gamma": 0.9}})
    second = trained(tmp_path, "second", {"TD3": other}, [{"every": "step"}], range(2, 6))
    table = score_table([first, second])
    assert len(without_copies(table)) == (6 if is_copy else 8)
    assert sorted(map(len, cells_of(table, "score").values())) == ([6] if is_copy else [4, 4])


def test_other_methods_tasks_and_lengths_are_no_copies(tmp_path: Path) -> None:
    places = list(itertools.product(("A", "B"), ("Pendulum-v1", "Reacher-v5")))
    facts = {"configurations": {method: {"algo": "td3"} for method in ("A", "B")}}
    studies = [
        study(tmp_path, [record(method, 0, 1.0, task, steps=steps) for method, task in places], f"s{number}", **facts)
        for number, steps in enumerate((1_000, 500, 500))
    ]
    table = score_table(studies)
    assert (len(table), len(without_copies(table))) == (12, 8)


def test_copies_are_drawn_together_where_they_are_compared(tmp_path: Path) -> None:
    """Against three configurations that never differ, as against one of them."""
    studies = []
    for number in (1, 3):
        copied = trained(tmp_path, f"c{number}", {"TQC": {"algo": "tqc"}}, SAMPLES[:number])
        others = runs(lambda *_: 0.0, ["CGP"], SAMPLES[:number])
        entries = {configuration_in_words("CGP", run.settings): {"algo": "cgp", **run.settings} for run in others}
        studies.append(
            study(tmp_path, copied.records + others, f"s{number}", configurations=copied.facts["configurations"] | entries)
        )
    tables = [score_table([each]) for each in studies]
    one, three = (
        compare(table.assign(task=table["cell"]), ("CGP", "TQC"), probability_of_improvement, "score", 200) for table in tables
    )
    assert one is not None
    assert three is not None
    assert one.interval == three.interval
    assert one.interval is not None
    assert one.interval[0] < one.interval[1]
    row = improvement_table(tables[1], "CGP", ["CGP", "TQC"], 200).splitlines()[2]
    assert f"{one.in_words()}" in row


def test_claims_and_rows_on_all_tasks_count_copies_once(tmp_path: Path) -> None:
    entries = {"CGP-Online": {"algo": "cgp"}, "CGP-Offline": {"algo": "cgp", "policy_training": "offline"}}
    tables = []
    for names in (("one",), ("one", "two")):
        records = runs(
            lambda method, _, seed: FINALS[seed] + FINALS[7 - seed] * (method == "CGP-Online"),
            entries,
            tasks=["Pendulum-v1", "Reacher-v5"],
        )
        tables.append(score_table([study(tmp_path, records, name, configurations=entries) for name in names]))
    one, both = ([part.text for part in online_better(table, 200)] for table in tables)
    assert one == both
    rows = [pooled_rows(table, list(entries)) for table in tables]
    assert rows[0] == rows[1]
    assert rows[0][0][-1] == "8 and 8"
