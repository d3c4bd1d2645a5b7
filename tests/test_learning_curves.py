"""Learning curves: where points stand by steps and by minutes, published returns, and studies that are not finished."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from finished_studies import record, runs, write_study
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from tables import unpadded

from benchmark.common.records import RUNS, Record, read_records
from benchmark.common.style import METHODS
from benchmark.reporting import figures as command
from benchmark.reporting import learning_curves
from benchmark.reporting.figures import draw, figures, minutes_caption
from benchmark.reporting.interactive import figure
from benchmark.reporting.learning_curves import curves_by_minutes, curves_by_steps, times_of
from benchmark.reporting.literature import literature_section, published
from benchmark.reporting.scores import Study, read_study
from benchmark.reporting.summary import summary

E10 = ["CGP-Online", "CGP-Light", "QGP-Online", "TD3", "SAC", "CGP-Online by CEM"]
FORBIDDEN = ["ForbiddenPendulum-v1", "ForbiddenHopper-v1"]


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """Keep the figures in place of their pictures."""
    kept: list[Figure] = []
    monkeypatch.setattr(learning_curves, "png", lambda figure: kept.append(figure) or b"")
    return kept


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Write empty files in place of pictures."""
    for name in ("curves_by_steps", "curves_by_minutes", "final_rewards"):
        monkeypatch.setattr(command, name, lambda *args: b"")


def timed(method: str, seed: int, minutes: float | None, **options: object) -> Record:
    """A run of 1,000 steps, evaluated every 250, that took so long."""
    run = record(method, seed, 40.0, returns=[10.0, 20.0, 30.0, 40.0], **options)  # type: ignore[arg-type]
    return replace(run, processor_seconds=None if minutes is None else 60 * minutes)


def study(folder: Path, records: list[Record], **facts: object) -> Study:
    found = read_study(write_study(folder / "sweep", records))
    found.facts.update(facts)
    return found


def lines(panel: Axes) -> dict[str, tuple[list[float], list[float]]]:
    """Return the points of each line in the legend by its label."""
    labelled = [line for line in panel.get_lines() if not str(line.get_label()).startswith("_")]
    return {str(line.get_label()): (list(line.get_xdata()), list(line.get_ydata())) for line in labelled}


def test_evaluations_stand_at_their_share_of_the_time(tmp_path: Path, drawn: list[Figure]) -> None:
    chosen = study(tmp_path, [timed("TD3", 0, 8.0), timed("TD3", 1, 12.0), timed("SAC", 0, 40.0)], seeds=[0, 1])
    curves_by_minutes(chosen, "Pendulum-v1", 20)
    for panel in drawn[0].axes:
        assert panel.get_xlabel() == "minutes of processor time"
    found = lines(drawn[0].axes[0])
    assert found["TD3"][0] == pytest.approx([2.5, 5.0, 7.5, 10.0])
    assert found["SAC (1 of 2 seeds)"][0] == pytest.approx([10.0, 20.0, 30.0, 40.0])
    assert found["TD3"][1] == [10.0, 20.0, 30.0, 40.0]


def test_random_steps_at_the_start_need_no_time(tmp_path: Path, drawn: list[Figure]) -> None:
    configurations = {"TD3": {"learning_starts": 500}, "SAC,Pendulum-v1": {"learning_starts": 250}, "CGP-Online": {}}
    records = [timed("TD3", 0, 8.0), timed("SAC", 0, 3.0), timed("CGP-Online", 0, 4.0)]
    chosen = study(tmp_path, records, seeds=[0], configurations=configurations)
    curves_by_minutes(chosen, "Pendulum-v1", 20)
    found = lines(drawn[0].axes[0])
    assert {name: pytest.approx(x) for name, (x, _) in found.items()} == {
        "TD3": [0.0, 0.0, 4.0, 8.0], "SAC": [0.0, 1.0, 2.0, 3.0], "CGP-Online": [1.0, 2.0, 3.0, 4.0]
    }  # fmt: skip
    (trace,) = (each for each in interactive_lines(chosen) if each["name"] == "TD3")
    assert trace == {"name": "TD3", "minutes": [0.0, 0.0, 4.0, 8.0]}


def interactive_lines(chosen: Study) -> list[dict[str, object]]:
    """Return what the button "by minutes" shows of each method's line."""
    drawn = figure(chosen, "Pendulum-v1", 20)
    _, by_minutes = drawn["layout"]["updatemenus"][0]["buttons"]
    minutes = by_minutes["args"][0]["x"]
    return [
        {"name": trace["name"], "minutes": x}
        for trace, x in zip(drawn["data"], minutes, strict=True)
        if trace["meta"]["kind"] == "seed"
    ]


def test_offline_variants_have_no_minutes(tmp_path: Path, drawn: list[Figure]) -> None:
    """Their time is that of the training after the last step, too."""
    configurations = {"CGP-Offline": {"policy_training": "offline"}, "TD3": {}}
    records = [timed("TD3", 0, 8.0), timed("CGP-Offline", 0, 9.0)]
    chosen = study(tmp_path, records, seeds=[0], configurations=configurations)
    curves_by_minutes(chosen, "Pendulum-v1", 20)
    assert list(lines(drawn[0].axes[0])) == ["TD3"]
    assert minutes_caption(chosen, "Pendulum-v1").endswith("after the last step: CGP-Offline.")
    assert [len(line["minutes"]) for line in interactive_lines(chosen)] == [4, 0]  # type: ignore[arg-type]
    alone = study(tmp_path, records[1:], configurations=configurations)
    assert times_of(alone, "Pendulum-v1").runs == []


def test_runs_without_a_time_are_left_out_with_a_note(tmp_path: Path) -> None:
    failing = replace(record("TD3", 3, None, returns=[10.0]), processor_seconds=1.0)
    hopeless = replace(record("DDPG", 0, None, returns=[10.0]), processor_seconds=1.0)
    records = [timed("TD3", 0, 8.0), timed("TD3", 1, None), timed("SAC", 0, None), failing, hopeless]
    chosen = study(tmp_path, records)
    times = times_of(chosen, "Pendulum-v1")
    # A failed run has the time of those that were complete
    assert sorted((run.method, run.seed) for run in times.runs) == [("TD3", 0), ("TD3", 3)]
    assert times.minutes_per_step == {"TD3": pytest.approx(8 / 1_000)}
    assert minutes_caption(chosen, "Pendulum-v1").endswith(
        "Left out: 2 runs without a recorded time. Left out: 1 run of methods without a complete run with a time."
    )
    assert "Left out" not in minutes_caption(study(tmp_path, [timed("TD3", 0, 8.0)]), "Pendulum-v1")


@pytest.mark.parametrize(("threads", "is_said"), [([1, 1], False), ([2, 1], True)])
def test_commands_with_other_numbers_of_threads_are_told(tmp_path: Path, threads: list[int], is_said: bool) -> None:
    commands = [{"machine": {**command_on("AMD")["machine"], "torch_threads": each}} for each in threads]
    caption = minutes_caption(study(tmp_path, [timed("TD3", 0, 8.0)], commands=commands), "Pendulum-v1")
    assert ("The commands used 1 or 2 threads" in caption) == is_said


def command_on(cpu: str, capability: str = "AVX2", gpu: str | None = None) -> dict[str, dict[str, object]]:
    return {"machine": {"cpu": cpu, "cpu_capability": capability, "gpu": gpu}}


@pytest.mark.parametrize(
    ("commands", "named"),
    [
        ([command_on("AMD")], None),
        ([command_on("AMD"), command_on("AMD")], None),
        ([command_on("AMD"), command_on("AMD", "AVX512")], "AMD (AVX2), AMD (AVX512)"),
        ([command_on("Intel"), command_on("AMD")], "AMD (AVX2), Intel (AVX2)"),
        ([command_on("AMD"), command_on("AMD", gpu="H100")], "AMD (AVX2), H100"),
        ([command_on("AMD", gpu="H100"), command_on("Intel", gpu="H100")], None),
    ],
)
def test_runs_whose_processors_were_not_recorded(
    tmp_path: Path, commands: list[dict[str, dict[str, object]]], named: str | None
) -> None:
    chosen = study(tmp_path, [timed("TD3", 0, 8.0)], commands=commands)
    caption = minutes_caption(chosen, "Pendulum-v1")
    _, by_minutes = figure(chosen, "Pendulum-v1", 20)["layout"]["updatemenus"][0]["buttons"]
    assert ("machines" in by_minutes["args"][1]["xaxis.title.text"]) == (named is not None)
    if named is None:
        assert "machines" not in caption
    else:
        assert caption.endswith(f"on different machines ({named}), so their times cannot be compared.")


def test_runs_whose_processor_was_not_recorded_have_that_of_all_commands(tmp_path: Path) -> None:
    """Two commands on one processor, by an earlier version and by this one."""
    records = [timed("TD3", 0, 2.0), replace(timed("TD3", 1, 4.0), processors=["AMD (AVX2)"])]
    chosen = study(tmp_path, records, commands=[command_on("AMD"), command_on("AMD")])
    assert times_of(chosen, "Pendulum-v1").minutes_per_step == {"TD3": pytest.approx(3.0 / 1_000)}
    assert "machines" not in minutes_caption(chosen, "Pendulum-v1")


# On the fast processor TD3 takes 2 minutes and SAC 3, on the slow one three times as long
FAST, SLOW = ["fast"], ["slow"]


@pytest.mark.parametrize(
    ("processors", "minutes", "compared"),
    [
        # TD3's and SAC's runs, two each
        ([FAST, FAST, FAST, FAST], (2.0, 3.0), []),
        ([FAST, SLOW, FAST, FAST], (2.0, 3.0), ["fast"]),
        ([SLOW, SLOW, SLOW, FAST], (6.0, 9.0), ["slow"]),
        # As many on both: the first by name
        ([FAST, SLOW, FAST, SLOW], (2.0, 3.0), ["fast"]),
        # Continued on the other processor
        ([[*FAST, *SLOW], FAST, FAST, SLOW], (2.0, 3.0), ["fast"]),
        # No processor trained both methods
        ([FAST, FAST, SLOW, SLOW], (2.0, 9.0), ["fast", "slow"]),
        ([FAST, FAST, [*FAST, *SLOW], SLOW], (2.0, 9.0), ["fast", "slow"]),
    ],
)
def test_times_are_compared_on_one_processor(
    tmp_path: Path, processors: list[list[str]], minutes: tuple[float, float], compared: list[str]
) -> None:
    records = []
    for index, names in enumerate(processors):
        alone = 2.0 if index < 2 else 3.0
        run = timed("TD3" if index < 2 else "SAC", index % 2, 3 * alone if "slow" in names else alone)
        records.append(replace(run, processors=names))
    chosen = study(tmp_path, records, seeds=[0, 1])
    times = times_of(chosen, "Pendulum-v1")
    assert [times.minutes_per_step[method] * 1_000 for method in ("TD3", "SAC")] == pytest.approx(minutes)
    # The curves show all runs
    assert times.runs == chosen.records
    caption = minutes_caption(chosen, "Pendulum-v1")
    if not compared:
        assert "machines" not in caption
    elif len(compared) == 1:
        assert caption.endswith(f"on different machines (fast, slow); the times are those on {compared[0]}.")
    else:
        assert caption.endswith("on different machines (fast, slow), so their times cannot be compared.")
    assert (len(times.processors) > 1) == (len(compared) > 1)


def test_methods_without_a_run_on_the_processor_are_left_out(tmp_path: Path) -> None:
    records = [replace(timed("CGP-Online", 0, 40.0), processors=FAST), replace(timed("CGP-Light", 0, 10.0), processors=FAST)]
    records += [replace(timed("CGP-Light", 1, 30.0), processors=SLOW)]
    records += [replace(timed("TD3", seed, 12.0), processors=SLOW) for seed in range(3)]
    chosen = study(tmp_path, records, seeds=[0, 1, 2])
    # Both processors trained two methods, the slow one more runs of them
    times = times_of(chosen, "Pendulum-v1")
    assert times.minutes_per_step == {"CGP-Light": pytest.approx(0.03), "TD3": pytest.approx(0.012)}
    assert [run.method for run in times.runs] == ["CGP-Light"] * 2 + ["TD3"] * 3
    end = "(fast, slow); the times are those on slow. Left out, as they have no run there: CGP-Online."
    caption = minutes_caption(chosen, "Pendulum-v1")
    assert caption.endswith(end)
    assert "complete run" not in caption
    with_sac = study(tmp_path / "four", [*records, replace(timed("SAC", 0, 5.0), processors=FAST)], seeds=[0, 1, 2])
    paces = times_of(with_sac, "Pendulum-v1").minutes_per_step
    assert paces == {"CGP-Online": pytest.approx(0.04), "CGP-Light": pytest.approx(0.01), "SAC": pytest.approx(0.005)}


@pytest.mark.usefixtures("undrawn")
def test_records_from_before_the_time_was_measured(tmp_path: Path) -> None:
    folder = write_study(tmp_path / "old", [timed("TD3", 0, 8.0)])
    old = {name: value for name, value in asdict(timed("TD3", 0, None)).items() if name != "processor_seconds"}
    (folder / RUNS).write_text(json.dumps(old) + "\n")
    assert read_records(folder) == [timed("TD3", 0, None)]
    names = [Path(picture.path).name for picture in draw(read_study(folder), 20)]
    assert names == ["learning_curves_Pendulum-v1.png", "final_rewards.png"]
    # One run with a time is enough for the second figure
    study = read_study(write_study(folder, [timed("TD3", 0, None), timed("TD3", 1, 8.0)]))
    names = [Path(picture.path).name for picture in draw(study, 20)]
    assert not any("literature" in picture.caption for picture in draw(study, 20))
    assert names[:2] == ["learning_curves_Pendulum-v1.png", "learning_curves_by_minutes_Pendulum-v1.png"]


def test_published_returns_are_hollow_markers_at_their_steps(tmp_path: Path, drawn: list[Figure]) -> None:
    chosen = study(tmp_path, [timed("TD3", seed, None, task="HalfCheetah-v5") for seed in range(2)], steps=100_000)
    assert "Open markers are mean returns from the literature" in draw(chosen, 20)[0].caption
    drawn.clear()
    curves_by_steps(chosen, "HalfCheetah-v5", 20)
    (panel,) = drawn[0].axes
    found = lines(panel)
    assert found["TD3, literature, v1"] == ([60_000, 100_000], [4332, 5514])
    assert found["SAC, literature, v4"] == ([99_996], [6156])
    (marks,) = (line for line in panel.get_lines() if line.get_label() == "TD3, literature, v1")
    assert (marks.get_markerfacecolor(), marks.get_linestyle()) == ("none", "None")
    assert (marks.get_color(), marks.get_marker()) == (METHODS["TD3"]["color"], METHODS["TD3"]["marker"])
    low, high = panel.get_ylim()
    assert low < 10.0 < 8112.0 <= high


def test_untrained_policies_do_not_squash_the_curves(tmp_path: Path, drawn: list[Figure]) -> None:
    """Of evaluations at 250, 500, 750 and 1,000 steps, with 500 random ones, the last two make the vertical axis."""
    records = [record("CEM", seed, -6.0, returns=[-90.0, -80.0, -10.0 - seed, -6.0]) for seed in range(4)]
    chosen = study(
        tmp_path, records, configurations={"CEM": {"algo": "cgp", "learning_starts": 500}, "Random": {"algo": "random"}}
    )
    curves_by_steps(chosen, "Pendulum-v1", 20)
    low, high = drawn[0].axes[0].get_ylim()
    assert -14 < low < -13
    assert -6 < high < -5
    # Where nothing was evaluated after them, all evaluations
    chosen.facts["configurations"]["CEM"]["learning_starts"] = 1_000
    curves_by_steps(chosen, "Pendulum-v1", 20)
    assert drawn[1].axes[0].get_ylim()[0] < -90


def test_few_methods_share_a_panel_and_many_have_their_own_beside_one_reference(tmp_path: Path, drawn: list[Figure]) -> None:
    def of(*methods: str) -> Study:
        return study(tmp_path, [timed(method, seed, None) for method in methods for seed in range(3)], seeds=[0, 1, 2])

    few = ["CGP-Online", "CGP-Light", "TD3", "SAC"]
    curves_by_steps(of(*few, "Random"), "Pendulum-v1", 20)
    curves_by_steps(of(*few, "DDPG"), "Pendulum-v1", 20)
    curves_by_steps(of("Random"), "Pendulum-v1", 20)
    together, apart, random = drawn
    # Four interquartile means, and each method's three seeds
    assert list(lines(together.axes[0])) == few
    assert len(together.axes[0].get_lines()) == 4 + 4 * 3
    assert [panel.get_title() for panel in apart.axes] == [*few, "DDPG"]
    for panel in apart.axes:
        shown = [] if panel.get_title() == "TD3" else ["TD3, in all panels"]
        assert list(lines(panel)) == shown
        assert len(panel.get_lines()) == 1 + 3 + len(shown)
    assert len({panel.get_ylim() for panel in apart.axes}) == 1
    assert list(lines(random.axes[0])) == ["Random"]


def test_seeds_and_their_interquartile_mean(tmp_path: Path, drawn: list[Figure]) -> None:
    values = [1.0, 2.0, 4.0, 100.0]
    records = [record("TD3", seed, value, returns=[value] * 4) for seed, value in enumerate(values)]
    curves_by_steps(study(tmp_path, records, seeds=range(4)), "Pendulum-v1", 20)
    *seeds, middle = drawn[0].axes[0].get_lines()
    assert [list(line.get_ydata()) for line in seeds] == [[value] * 4 for value in values]
    assert list(middle.get_ydata()) == [3.0] * 4


def test_published_returns_of_other_tasks_and_later_steps_are_left_out(tmp_path: Path) -> None:
    assert published("Pendulum-v1", 10**9) == published("ForbiddenHopper-v1", 10**9) == published("Hopper-v5", 10_000) == []
    assert {entry.method for entry in published("Humanoid-v5", 100_000)} == {"SAC", "CrossQ"}
    assert max(step for entry in published("Hopper-v4", 100_000) for step in entry.returns) == 100_000
    assert max(step for entry in published("Hopper-v4", 300_000) for step in entry.returns) == 300_000
    for task in ("HalfCheetah", "Hopper", "Ant", "Humanoid"):
        for entry in published(f"{task}-v5", 300_000):
            assert entry.seeds == 10
            assert "https://github.com/" in entry.source
            assert list(entry.returns) == sorted(entry.returns)
            assert all(std > 0 for _, std in entry.returns.values())
    assert literature_section(["Pendulum-v1"], 10**9) == []
    _, table, note, sources = literature_section(["Ant-v5", "Pendulum-v1"], 100_000)
    assert "| Ant-v1 | TD3 | 100,000 | 586 ± 185 |" in unpadded(table)
    assert "not measured here" in note
    assert sources.splitlines()[0].startswith("- TD3, 10 seeds: TD3's authors")


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


def test_legend_says_where_seeds_are_missing(tmp_path: Path, drawn: list[Figure]) -> None:
    chosen = study(tmp_path, [*(timed("CGP-Light", seed, None) for seed in range(4)), timed("TD3", 0, None)])
    curves_by_steps(chosen, "Pendulum-v1", 20)
    assert list(lines(drawn[0].axes[0])) == ["CGP-Light", "TD3 (1 of 4 seeds)"]


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


@pytest.mark.parametrize("number", [2, 4])
def test_legends_fit_on_their_figures(tmp_path: Path, drawn: list[Figure], number: int) -> None:
    methods = ["CGP-Online by CEM", "QGP-Offline", *(f"CGP-Light-{letter}" for letter in "abcdefg")][:number]
    curves_by_steps(study(tmp_path, [timed(method, 0, None) for method in methods], seeds=range(12)), "Pendulum-v1", 20)
    figure = drawn[0]
    figure.draw_without_rendering()
    (legend,) = figure.legends
    assert 0 <= legend.get_window_extent().x0 < legend.get_window_extent().x1 <= figure.bbox.x1


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
    # Its tasks are not those of the paper's claims
    claims = text[text.index("## The paper's claims") : text.index("## How to read")]
    assert "online training" in claims
    assert "ForbiddenPendulum" not in claims
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


def test_random_actions_are_not_counted_among_the_runs_without_a_time(tmp_path: Path) -> None:
    chosen = study(tmp_path, [timed("TD3", 0, 8.0), timed("Random", 0, None)])
    assert "Left out" not in minutes_caption(chosen, "Pendulum-v1")
