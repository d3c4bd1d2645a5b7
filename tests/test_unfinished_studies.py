"""The page and the figures of studies that are not finished, or whose runs failed."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from drawn_studies import lines, timed
from finished_studies import record, runs, study, write_study
from matplotlib.figure import Figure
from tables import unpadded

from benchmark.common.records import Record
from benchmark.reporting.figures import draw, figures
from benchmark.reporting.interactive import figure
from benchmark.reporting.learning_curves import curves_by_steps
from benchmark.reporting.scores import read_study
from benchmark.reporting.summary import summary

E10 = ["CGP-Online", "CGP-Light", "QGP-Online", "TD3", "SAC", "CGP-Online by CEM"]
FORBIDDEN = ["ForbiddenPendulum-v1", "ForbiddenHopper-v1"]


@pytest.mark.usefixtures("undrawn")
def test_page_of_an_unfinished_study_says_how_many_seeds_each_method_has(tmp_path: Path) -> None:
    records = [*runs(lambda *_: 1.0, ["CGP-Light"]), *runs(lambda *_: 1.0, ["TD3"], seeds=range(2))]
    folder = write_study(tmp_path / "sweep", records, planned=16)
    facts = json.loads((folder / "study.json").read_text())
    facts |= {"methods": ["CGP-Online", "CGP-Light", "TD3"], "tasks": ["Pendulum-v1", "Ant-v5"]}
    (folder / "study.json").write_text(json.dumps(facts))
    text = unpadded(figures([folder], tmp_path, 20).read_text())
    assert "Runs that have ended, by task and method (4 seeds of each are planned):" in text
    assert "| task | CGP-Online | CGP-Light | TD3 |" in text
    assert "| Pendulum-v1 | 0 | 4 | 2 |" in text
    assert "| Ant-v5 | 0 | 0 | 0 |" in text
    assert "| too few seeds | 4 and 2 |" in text
    finished = unpadded(figures([write_study(tmp_path / "finished", records)], tmp_path, 20).read_text())
    assert "Runs that have ended" not in finished


@pytest.mark.usefixtures("undrawn")
def test_methods_may_have_different_numbers_of_seeds(tmp_path: Path, drawn: list[Figure]) -> None:
    records = [*(timed("CGP-Light", seed, 1.0) for seed in range(4)), *(timed("TD3", seed, 1.0) for seed in range(2))]
    chosen = study(tmp_path, records, seeds_of_methods={"CGP-Light": 4, "TD3": 2})
    curves_by_steps(chosen, "Pendulum-v1", 20)
    assert list(lines(drawn[0].axes[0])) == ["CGP-Light", "TD3"]
    assert {trace["name"] for trace in figure(chosen, "Pendulum-v1", 20)["data"]} == {"CGP-Light", "TD3"}
    (chosen.folder / "study.json").write_text(json.dumps(chosen.facts))
    assert "so far" not in figures([chosen.folder], tmp_path, 20).read_text()
    (chosen.folder / "study.json").write_text(json.dumps(chosen.facts | {"runs_planned": 7, "seeds_of_methods": {"TD3": 3}}))
    unfinished = unpadded(figures([chosen.folder], tmp_path, 20).read_text())
    assert "by task and method (planned seeds: 4 of CGP-Light, 3 of TD3):" in unfinished
    assert "| 2 of 3 so far | 0 |" in unfinished


def test_page_of_e10(tmp_path: Path) -> None:
    draw_reward = np.random.default_rng(0)
    level = dict(zip(E10, (90.0, 85.0, 80.0, 20.0, 30.0, 95.0), strict=True))
    records = runs(lambda method, *_: level[method] + draw_reward.normal(), E10, seeds=range(5), tasks=FORBIDDEN)
    folder = write_study(tmp_path / "e10", [replace(run, experiment="e10", processor_seconds=60.0) for run in records])
    text = unpadded(figures([folder], tmp_path, 100).read_text())
    assert "## The study e10, " in text
    assert "Seeds 0, 1, 2, 3, 4;" in text
    for task in FORBIDDEN:
        for method in E10:
            finals = sorted(run.final for run in records if (run.task, run.method) == (task, method) and run.final is not None)
            (line,) = (line for line in text.splitlines() if line.startswith(f"| {task} | {method} |") and "−" not in line)
            value, low, _, high = line.split("|")[3].replace("(", "").replace(")", "").split()
            # Of five runs, the interquartile mean leaves out the lowest and the highest
            assert float(value) == pytest.approx(np.mean(finals[1:4]), abs=0.06)
            assert finals[0] - 0.06 <= float(low) < float(value) < float(high) <= finals[4] + 0.06
    assert "| all tasks (2) | CGP-Online − TD3 |" in text
    assert {path.name for path in (tmp_path / "figures" / "e10").iterdir()} == {
        "final_rewards.png",
        *(f"learning_curves{kind}_{task}.png" for kind in ("", "_by_minutes") for task in FORBIDDEN),
    }


CRASHED = [record("TD3", seed, None, returns=[]) for seed in range(2)]


EARLY = [record("TD3", seed, 10.0, returns=[10.0]) for seed in range(2)]


SWEPT = runs(lambda *_: 1.0, ["TD3", "SAC"], [{"width": 32}, {"width": 64}])


@pytest.mark.parametrize(
    ("records", "kinds"),
    [
        ([timed("Random", 0, 1.0), *CRASHED], ["learning_curves", "final_rewards"]),
        ([timed("Random", 0, 1.0), timed("TD3", 0, None)], ["learning_curves", "final_rewards"]),
        (CRASHED, ["learning_curves", "final_rewards"]),
        ([*CRASHED, timed("SAC", 0, 1.0)], ["learning_curves", "learning_curves_by_minutes", "final_rewards"]),
        (EARLY, ["learning_curves", "final_rewards"]),
    ],
    ids=["only random actions were timed", "no learner was timed", "all crashed", "one method crashed", "none has learnt"],
)
def test_a_study_whose_learners_ended_early_is_drawn(records: list[Record], kinds: list[str], tmp_path: Path) -> None:
    records = [replace(run, processor_seconds=None) if run in EARLY else run for run in records]
    chosen = study(tmp_path, records, configurations={"TD3": {"learning_starts": 500}})
    assert [Path(picture.path).stem.removesuffix("_Pendulum-v1") for picture in draw(chosen, 20)] == kinds
    shown = {trace["legendgroup"] for trace in figure(chosen, "Pendulum-v1", 20)["data"]}
    assert shown == {run.method for run in records} - {"Random"}
    swept = read_study(write_study(tmp_path / "swept", SWEPT))
    if any(run.returns for run in records if run.method != "Random"):
        assert summary(chosen, swept, 20).startswith(b"\x89PNG")
    else:
        with pytest.raises(ValueError, match="sweep has no evaluation of CGP-Online, CGP-Light, TD3, SAC"):
            summary(chosen, swept, 20)
