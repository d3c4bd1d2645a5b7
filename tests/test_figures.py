"""``python -m benchmark.figures``: which figures studies get, and what they show."""

from pathlib import Path

import numpy as np
import pytest
from finished_studies import BASELINES, GRID, runs, score, write_study
from matplotlib.figure import Figure
from matplotlib.image import imread

from benchmark.common.style import FURTHER, METHODS, styles
from benchmark.figures import main
from benchmark.reporting import drawing, summary
from benchmark.reporting.drawing import differing_range, final_rewards, stability
from benchmark.reporting.scores import read_study, score_table


@pytest.fixture
def folder(drawn_studies: Path) -> Path:
    return drawn_studies


def test_figures_follow_from_the_runs(folder: Path) -> None:
    drawn = {path.relative_to(folder / "figures").as_posix() for path in folder.rglob("*.png")}
    axes = {"stability", "sensitivity_Pendulum-v1", "values_Pendulum-v1"}
    tasks = {"learning_curves_Pendulum-v1", "learning_curves_ALE_Pong-v5", "final_rewards"}
    expected = {f"{study}/{name}.png" for study in ("axis", "axes", "variants") for name in axes}
    assert drawn == {"stability.png"} | expected | {f"tasks/{name}.png" for name in tasks}


def test_stability_is_drawn_where_methods_differ() -> None:
    levels = np.array([-900.0, -200.0, -150.0, -120.0, -110.0])
    shares = np.array([[1.0, 1.0, 0.9, 0.5, 0.1], [1.0, 0.95, 0.7, 0.5, 0.0]])
    low, high = differing_range(levels, shares)
    assert -152 < low < -150
    assert -110 < high < -108
    low, high = differing_range(levels, shares[:1])
    assert low < -900 < -110 < high


def test_random_actions_do_not_squash_the_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept: list[Figure] = []
    monkeypatch.setattr(drawing, "png", lambda figure: kept.append(figure) or b"")
    for methods in (["CGP-Online", "TD3", "Random"], ["Random"]):
        chosen = read_study(write_study(tmp_path / "-".join(methods), runs(score, methods)))
        final_rewards(chosen, score_table([chosen]), 20)
    shown = [[label.get_text() for label in figure.axes[0].get_yticklabels()] for figure in kept]
    assert shown == [["CGP-Online", "TD3"], ["Random"]]
    low, high = kept[0].axes[0].get_xlim()
    assert -360 < low < high < -100


def test_a_row_of_panels_for_each_value_and_a_line_for_each_of_the_last_axis(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept: list[Figure] = []
    monkeypatch.setattr(drawing, "png", lambda figure: kept.append(figure) or b"")
    for name, rows in (("axis", 1), ("axes", 2)):
        chosen = read_study(folder / name)
        drawing.sensitivity(chosen, "Pendulum-v1")
        panels = kept[-1].axes
        assert len(panels) == rows * len(BASELINES)
        assert [panel.get_title() for panel in panels[: len(BASELINES)]] == list(BASELINES)
        last = list(chosen.axes.values())[-1]
        assert all([str(line.get_label()) for line in panel.get_lines()] == list(map(str, last)) for panel in panels)


def test_figures_are_pictures_of_some_size_and_few_bytes(folder: Path) -> None:
    for path in folder.rglob("*.png"):
        height, width, _ = imread(path).shape
        assert 300 < height < 2_000
        assert 400 < width < 2_000
        assert path.stat().st_size < 250_000


def test_pictures_have_the_methods_own_colours(folder: Path) -> None:
    pixels = (imread(folder / "figures/tasks/final_rewards.png")[:, :, :3] * 255).round().astype(int)
    shown = {f"#{red:02X}{green:02X}{blue:02X}" for red, green, blue in np.unique(pixels.reshape(-1, 3), axis=0)}
    for look in styles([*BASELINES, "My-PPO"]).values():
        assert look["color"].upper() in shown


def test_stability_figure_of_equal_scores(tmp_path: Path) -> None:
    table = score_table([read_study(write_study(tmp_path / "sweep", runs(lambda *_: 1.0, BASELINES, GRID)))])
    assert stability(table, BASELINES, 20).startswith(b"\x89PNG")


def test_looks_are_the_methods_own() -> None:
    looks = styles(["TD3", "Mine", "Yours"])
    assert looks["TD3"] == METHODS["TD3"]
    assert styles(["Mine"])["Mine"] == looks["Mine"]
    assert looks["Mine"] != looks["Yours"]
    assert len({str(look) for look in styles(f"method {number}" for number in range(30)).values()}) == 30
    assert not any(look in FURTHER for look in METHODS.values())
    # In grey print, too, line and marker tell the paper's methods apart
    assert len({(str(look["linestyle"]), look["marker"]) for look in METHODS.values()}) == len(METHODS)


def test_summary_is_learning_curves_beside_stability(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    kept: list[Figure] = []
    draw = summary.png
    monkeypatch.setattr(summary, "png", lambda figure: kept.append(figure) or draw(figure))
    options = ["--folder", str(folder), "--repetitions", "20", "--summary", str(tmp_path / "summary.png")]
    before = (folder / "results.md").read_bytes()
    main(["tasks", "axes", *options])
    assert (tmp_path / "summary.png").read_bytes().startswith(b"\x89PNG")
    assert (folder / "results.md").read_bytes() == before
    left, right = kept[0].axes
    assert (left.get_title(), right.get_title()) == ("Pendulum-v1", "Pendulum-v1, 4 settings")
    for panel in (left, right):
        names = [str(line.get_label()) for line in panel.get_lines() if not str(line.get_label()).startswith("_")]
        assert names == ["CGP-Online", "TD3", "SAC"]
    for studies, fault in (
        (["axes", "tasks"], "must be a study of learning curves"),
        (["tasks", "tasks"], "one of hyperparameters"),
    ):
        with pytest.raises(SystemExit, match=fault):
            main([*studies, *options])
    with pytest.raises(SystemExit):
        main(["tasks", *options])
    assert "name two studies" in capsys.readouterr().err
