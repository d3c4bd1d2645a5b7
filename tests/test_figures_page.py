"""``python -m benchmark.figures``: what the page says, and that it repeats."""

import json
import re
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from finished_studies import BASELINES, GRID, SWEEP, record, runs, score, write_study
from tables import unpadded

from benchmark.figures import main
from benchmark.reporting import figures as command
from benchmark.reporting.figures import figures, stability_together, study_folders
from benchmark.reporting.overview import anchor, finding
from benchmark.reporting.scores import curves, evaluation_grid, read_study, score_table
from benchmark.reporting.sections import comparison_tables, reward_tables


@pytest.fixture
def folder(drawn_studies: Path) -> Path:
    return drawn_studies


def test_page_shows_every_figure_with_its_command(folder: Path, tmp_path: Path) -> None:
    text = (folder / "results.md").read_text()
    shown = re.findall(r"^!\[.+\]\((.+)\)$", text, flags=re.MULTILINE)
    assert sorted(shown) == sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.png"))
    assert text.count("\n\n*") >= len(shown)

    # The command in a study's section draws its figures, and leaves the page as it is
    section = next(part for part in text.split("\n## ") if "figures/axis/stability.png" in part)
    program, _, module, *arguments = shlex.split(section.partition("The figures: `")[2].partition("`")[0])
    assert (program, module) == ("python", "benchmark.figures")
    arguments[arguments.index("--folder") + 1] = str(tmp_path)
    main(arguments)
    for drawn in (folder / "figures/axis").iterdir():
        assert (tmp_path / "figures/axis" / drawn.name).read_bytes() == drawn.read_bytes()
    assert not (tmp_path / "results.md").exists()


def test_a_section_for_each_task_with_the_records_and_all_commands_in_folds(folder: Path) -> None:
    text = (folder / "results.md").read_text()
    headings = [line for line in text.splitlines() if line.startswith("## ")]
    assert len(set(headings)) == len(headings)
    assert {
        "## The study tasks, CGP-Online, TD3, SAC, My-PPO (tasks)",
        "## Pendulum-v1: The study tasks, CGP-Online, TD3, SAC, My-PPO (tasks)",
        "## ALE/Pong-v5: The study tasks, CGP-Online, TD3, SAC, My-PPO (tasks)",
        "## Pendulum-v1: The study variants, CGP-Online, CGP-Offline (variants)",
    } < set(headings)
    assert "[runs.jsonl](axis/runs.jsonl)" in text
    unfolded = re.sub(r"<details>.*?</details>", "", text, flags=re.DOTALL)
    for hidden in (f"python -m {SWEEP}", "commit ", "numpy "):
        assert hidden in text
        assert hidden not in unfolded
    # A Git host and MyST read Markdown within an element after an empty line only
    assert text.count("</summary>\n\n") == text.count("<details>") == text.count("\n\n</details>")


def test_findings_link_to_their_sections(folder: Path) -> None:
    text = (folder / "results.md").read_text()
    anchors = {anchor(line[3:]) for line in text.splitlines() if line.startswith("## ")}
    links = re.findall(r"\]\(#([^)]+)\)", text)
    assert len(links) == 5
    assert set(links) <= anchors
    rows = unpadded(text.partition("## Findings by task")[2].partition("\n## ")[0])
    assert "| 1,000 | 24 of 30 so far | Highest: CGP-Online" in rows
    assert "CGP-Online: rank 1 of 4; higher than TD3, SAC, My-PPO." in rows


@pytest.mark.usefixtures("undrawn")
def test_one_seed_of_a_few_methods_concludes_nothing(tmp_path: Path) -> None:
    folder = write_study(tmp_path / "begun", runs(score, BASELINES, seeds=[0]), planned=24)
    facts = json.loads((folder / "study.json").read_text())
    facts |= {"seeds": [0, 1, 2, 3], "tasks": ["Pendulum-v1", "Reacher-v5"]}
    (folder / "study.json").write_text(json.dumps(facts))
    text = unpadded(figures([folder], tmp_path, 20).read_text())
    assert "**Unfinished, so that results may change: begun (3 of 24 runs).**" in text
    assert "3 of 12 so far" in text
    assert "**Too few runs of CGP-Online, TD3, SAC: nothing is concluded on them.**" in text
    assert "| Reacher-v5, begun | 1,000 | 0 of 12 so far | no run has ended |" in text
    assert "| 1 of 4 so far | 0 |" in text
    assert "Methods are compared from 4 runs on, which none of them has yet." in text
    assert "Differences between methods" not in text


@pytest.mark.usefixtures("undrawn")
def test_page_repeats(folder: Path, tmp_path: Path) -> None:
    for study in study_folders(folder):
        shutil.copytree(study, tmp_path / study.name)
    again = figures(study_folders(tmp_path), tmp_path, repetitions=100).read_text()
    assert again.replace(str(tmp_path), str(folder)) == (folder / "results.md").read_text()


def test_the_figure_of_all_sweeps_names_the_methods_that_some_lack(tmp_path: Path) -> None:
    methods = list(BASELINES)
    all_of_them, fewer = (
        read_study(write_study(tmp_path / name, runs(score, chosen, GRID[:2])))
        for name, chosen in (("complete", methods), ("fewer", methods[:2]))
    )
    (picture,) = stability_together([all_of_them, fewer], 20)
    assert picture.caption.endswith(f"as methods are missing: {', '.join(methods[2:])} in fewer.")
    (picture,) = stability_together([all_of_them, all_of_them], 20)
    assert "missing" not in picture.caption


def test_page_names_sweeps_runs_and_failures(folder: Path) -> None:
    text = unpadded((folder / "results.md").read_text())
    assert f"`python -m {SWEEP} axis --results {folder}`" in text
    assert "24 of 30 planned runs have ended, 1 of them failed. **The rest is missing" in text
    assert "- TD3: `ValueError: NaN` (1 run)" in text
    assert "counts with the lowest return that any evaluation" in text
    assert "My-PPO" in text
    assert "of all sweeps (axes, axis) that name the method" in text
    # TD3's failed run counts as the lowest return of the task, -1000
    row = next(line for line in text.splitlines() if line.startswith("| Pendulum-v1 | learning rate 0.01 | TD3 |"))
    assert row.endswith("| -474.0 | -1000.0 | -297.0 | 4 | 1 |")


def test_probability_of_improvement_is_sure_where_it_is(folder: Path) -> None:
    text = unpadded((folder / "results.md").read_text())
    assert "| My-PPO | 1.00 (no interval) | 1.00 (no interval) | 1.00 (no interval) |" in text


@pytest.mark.usefixtures("undrawn")
def test_single_seed_and_a_study_without_runs(tmp_path: Path) -> None:
    single = write_study(tmp_path / "e3", runs(score, BASELINES, GRID[:2], seeds=[0]))
    empty = write_study(tmp_path / "empty", [], planned=8)
    text = unpadded(figures([single, empty], tmp_path, repetitions=50).read_text())
    assert "-150 (no interval)" in text.replace("-150.0", "-150")
    assert "0 of 8 planned runs have ended" in text
    # One seed supports no claim, and the cost of inference was not measured on these runs
    assert "**supported**" not in text


def test_a_method_whose_runs_all_failed_before_an_evaluation(tmp_path: Path) -> None:
    records = [record("PPO", seed, None, returns=[]) for seed in range(2)]
    alone = figures([write_study(tmp_path / "alone", records)], tmp_path, repetitions=20).read_text()
    assert "2 of 2 planned runs have ended, 2 of them failed." in alone
    # On the axis of those who got further, at the floor
    study = read_study(write_study(tmp_path / "beside", records + runs(score, ["TD3"], seeds=range(2))))
    grid = evaluation_grid(study.records, "Pendulum-v1")
    assert curves(records, -7.0, grid).tolist() == [[-7.0] * 4] * 2
    assert "| Pendulum-v1 | PPO |" in unpadded(figures([study.folder], tmp_path, repetitions=20).read_text())


def test_what_was_tried_in_small_leaves_claims_as_they_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # The figures of a single study do not depend on others
    monkeypatch.setattr(command, "draw", lambda *args: [])

    def claims_and_stability(*studies: str) -> tuple[str, bytes]:
        out = tmp_path / "-".join(studies)
        text = figures([tmp_path / study for study in studies], out, repetitions=50).read_text()
        claims = text[text.index("## The paper's claims") : text.index("## Findings by task")]
        return claims, (out / "figures/stability.png").read_bytes()

    write_study(tmp_path / "e3", runs(score, BASELINES, [{"learning_rate": 0.01}, {"learning_rate": 0.001}]))
    write_study(tmp_path / "e3-sizes", runs(score, BASELINES, GRID))
    opposite = runs(lambda *run: -200.0 - (score(*run) or 0.0), BASELINES, GRID)
    write_study(tmp_path / "e3-shorter", [replace(run, steps=run.steps // 2) for run in opposite])
    write_study(tmp_path / "e3-equal", opposite)
    write_study(tmp_path / "e4", [replace(run, steps=run.steps // 2, experiment="e4") for run in opposite])
    before = claims_and_stability("e3", "e3-sizes")
    assert claims_and_stability("e3", "e3-sizes", "e3-shorter") == before
    for study in ("e3-equal", "e4"):
        claims, picture = claims_and_stability("e3", "e3-sizes", study)
        assert claims != before[0]
        assert picture != before[1]


def test_settings_stand_in_the_order_of_the_axes(tmp_path: Path) -> None:
    configurations = [{"noise": value} for value in (0.3, 0.05, 0.1)]
    study = read_study(write_study(tmp_path / "sweep", list(reversed(runs(score, ["TD3"], configurations)))[::-1]))
    _, detailed = reward_tables(score_table([study]), study, repetitions=20)
    assert [line.split("|")[2].strip() for line in detailed.splitlines() if line.startswith("| Pendulum")] == [
        "noise 0.3",
        "noise 0.05",
        "noise 0.1",
    ]


def test_methods_that_lack_an_axis(tmp_path: Path) -> None:
    records = [
        *runs(score, ["CGP-Online"], GRID),
        *runs(score, ["SAC"], [{"batch_size": 32}]),
        record("PPO", 0, None, returns=[]),
    ]
    text = unpadded(figures([write_study(tmp_path / "sweep", records)], tmp_path, repetitions=20).read_text())
    assert "| Pendulum-v1 | batch size 32 | SAC |" in text


@pytest.mark.parametrize(
    ("experiment", "first"),
    [
        ("e3", "## The paper's claims"),
        ("e8", "## The paper's claims"),
        ("mine", "## Findings by task"),
        ("e10", "## Findings by task"),
        ("e10-quick", "## Findings by task"),
    ],
)
def test_page_begins_with_the_findings(experiment: str, first: str, tmp_path: Path) -> None:
    """... on the paper's claims, if one of its experiments is on the page. How to read them comes last."""
    study = write_study(tmp_path / experiment, runs(score, BASELINES[:2], GRID[:2]))
    headings = [line for line in figures([study], tmp_path, 20).read_text().splitlines() if line.startswith(("# ", "## "))]
    assert headings[:2] == ["# Results of sweeps", first]
    assert headings[-1] == "## How to read this page"
    assert headings.count("## The paper's claims") == (first == "## The paper's claims")


@pytest.mark.parametrize(
    ("levels", "sentences"),
    [
        # The difference of CGP-Light and CGP-Online is told under the first
        ({"CGP-Light": -50, "CGP-Online": -99, "TD3": -99}, ["higher than CGP-Online, TD3", "not distinguishable from TD3"]),
        ({"CGP-Online": -99, "TD3": -99, "SAC": -99}, ["not distinguishable from any other"]),
        ({"CGP-Online": -99, "TD3": -99, "SAC": None}, ["not distinguishable from TD3"]),
        ({"CGP-Online": -99, "TD3": -199, "SAC": -99}, ["higher than TD3; not distinguishable from SAC"]),
    ],
)
def test_a_finding_names_the_methods_that_it_is_about(
    tmp_path: Path, levels: dict[str, float | None], sentences: list[str]
) -> None:
    """... of which None has too few runs."""
    methods = [method for method, level in levels.items() if level is not None]
    records = runs(lambda method, _, seed: (levels[method] or 0.0) + seed, methods)
    records += [record(method, 0, -90.0) for method in levels if method not in methods]
    study = read_study(write_study(tmp_path / "sweep", records))
    found = finding(study, score_table([study]), "Pendulum-v1", 20)
    assert [
        each.partition("; ")[2].rstrip(".") for each in re.split(r"(?<=[a-zA-Z0-9)])\. ", found) if "; " in each
    ] == sentences


def test_methods_of_a_users_own_are_compared(tmp_path: Path) -> None:
    levels = {"CGP": -50.0, "TQC": -90.0, "PPO": -99.0}
    study = read_study(write_study(tmp_path / "mine", runs(lambda method, _, seed: levels[method] + seed, levels)))
    table = score_table([study])
    assert "CGP: rank 1 of 3; higher than TQC, PPO." in finding(study, table, "Pendulum-v1", 20)
    differences, tabulated, improvement = comparison_tables(table, study, 20)
    assert differences == "**Differences between methods**"
    assert "CGP − TQC" in tabulated
    assert "Probability that CGP improves on the others" in improvement


def test_runs_at_numbers_that_are_none(tmp_path: Path) -> None:
    records = [*runs(score, ["CGP-Online"]), record("TD3", 0, None, returns=[-700.0, float("nan")])]
    study = read_study(write_study(tmp_path / "sweep", records))
    assert np.isfinite(score_table([study])["score"]).all()
    assert "1 of them failed" in figures([study.folder], tmp_path, repetitions=20).read_text()


def test_methods_of_too_few_runs_are_named_beside_those_of_enough(tmp_path: Path) -> None:
    """Also where another method has enough, so that its differences are judged."""
    records = [*runs(score, ["CGP-Online", "SAC"]), *runs(score, ["TD3"], seeds=range(3))]
    study = read_study(write_study(tmp_path / "sweep", records))
    found = finding(study, score_table([study]), "Pendulum-v1", 20)
    assert "higher than SAC" in found
    assert found.endswith("**Too few runs of TD3: nothing is concluded on them.**")
    assert "Too few" not in finding(study, score_table([study]).query("method != 'TD3'"), "Pendulum-v1", 20)
