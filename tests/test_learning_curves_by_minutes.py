"""Learning curves by minutes of processor time: where points stand, and which times are compared."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest
from drawn_studies import lines, timed
from finished_studies import record, study, write_study
from matplotlib.figure import Figure

from benchmark.common.records import RUNS, read_records
from benchmark.reporting.figures import draw, minutes_caption
from benchmark.reporting.interactive import figure
from benchmark.reporting.learning_curves import curves_by_minutes, first_training_step, times_of
from benchmark.reporting.scores import Study, read_study


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


def test_the_default_number_of_random_steps_is_the_algorithms(tmp_path: Path) -> None:
    configurations = {"TD3": {"algo": "td3"}, "CGP": {"algo": "cgp", "learning_starts": 50}, "PPO": {"algo": "ppo"}}
    chosen = study(tmp_path, [timed(method, 0, 8.0) for method in configurations], configurations=configurations)
    assert times_of(chosen, "Pendulum-v1").random_steps == {"TD3": 100, "CGP": 50, "PPO": 0}
    assert first_training_step(chosen) == 100


def test_a_run_that_is_longer_than_planned_has_the_time_of_all_its_steps(tmp_path: Path) -> None:
    longer = replace(timed("PPO", 0, 8.0), timesteps=[500, 1_000, 1_500, 2_000])
    assert times_of(study(tmp_path, [longer]), "Pendulum-v1").minutes_per_step == {"PPO": 8.0 / 2_000}


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


def test_random_actions_are_not_counted_among_the_runs_without_a_time(tmp_path: Path) -> None:
    chosen = study(tmp_path, [timed("TD3", 0, 8.0), timed("Random", 0, None)])
    assert "Left out" not in minutes_caption(chosen, "Pendulum-v1")
