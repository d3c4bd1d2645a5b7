"""On which processors the methods of a study were trained, said where two of them have none in common."""

from dataclasses import replace
from pathlib import Path

import pytest
from finished_studies import record, study

from benchmark.common.provenance import processors_of_commands
from benchmark.reporting.machines import CONSEQUENCE, different_processors
from benchmark.reporting.scores import score_table
from benchmark.reporting.sections import comparison_tables


@pytest.mark.parametrize(
    ("places", "found"),
    [
        ({"CGP-Online": [["A"], ["B"]], "TD3": [["B"], ["B"]], "SAC": [["B", "C"], ["A"]]}, None),
        ({"CGP-Online": [["A"], ["A"]], "TD3": [["B"], ["B"]], "SAC": [["B"], ["B"]]}, "CGP-Online on A; TD3, SAC on B"),
        (
            {"CGP-Online": [["A"], ["A", "B"]], "TD3": [["B"], ["B"]], "SAC": [["A"], ["A"]]},
            "CGP-Online on A and B; TD3 on B; SAC on A",
        ),
    ],
)
def test_processors_are_listed_where_two_methods_have_none_in_common(
    tmp_path: Path, places: dict[str, list[list[str]]], found: str | None
) -> None:
    records = [
        replace(record(method, seed, -150.0), processors=names)
        for method, runs in places.items()
        for seed, names in enumerate(runs)
    ]
    expected = [] if found is None else [f"Methods were trained on different processors: {found}. {CONSEQUENCE}"]
    assert different_processors(study(tmp_path, records)) == expected


def test_runs_without_a_processor_may_be_on_those_of_all_commands(tmp_path: Path) -> None:
    unknown = record("TD3", 0, -150.0)
    (here,) = processors_of_commands(study(tmp_path / "commands", [unknown]).facts["commands"])
    same = [unknown, replace(record("CGP-Online", 0, -150.0), processors=[here])]
    assert different_processors(study(tmp_path / "same", same)) == []
    (text,) = different_processors(study(tmp_path / "other", [*same, replace(record("SAC", 0, -150.0), processors=["X"])]))
    assert f"TD3, CGP-Online on {here}; SAC on X" in text


def test_the_paragraph_follows_the_table_of_differences(tmp_path: Path) -> None:
    records = [
        replace(record(method, seed, -150.0 - seed), processors=[place])
        for method, place in (("CGP-Online", "A"), ("TD3", "B"))
        for seed in range(4)
    ]
    chosen = study(tmp_path, records)
    parts = comparison_tables(score_table([chosen]), chosen, 20)
    assert parts[2] == different_processors(chosen)[0]
    assert "CGP-Online − TD3" in parts[1]
