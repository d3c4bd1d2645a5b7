"""Figures are as large as their letters need."""

import io
import itertools
from pathlib import Path
from typing import Any

import pytest
from finished_studies import runs, write_study
from matplotlib.figure import Figure
from matplotlib.text import Text

from benchmark.common.canvas import legend, panels, png
from benchmark.reporting import drawing, learning_curves
from benchmark.reporting.scores import read_study, score_table

LONG = "A method with a long name"
AXES: list[list[dict[str, Any]]] = [
    [{"cem_samples": number} for number in (8, 32, 64)],
    [{"target_policy_noise": noise, "learning_rate": rate} for noise in (0.1, 0.25) for rate in (1e-3, 1e-4)],
]


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The figures that were saved."""
    figures: list[Figure] = []

    def save(figure: Figure) -> bytes:
        figures.append(figure)
        return png(figure)

    monkeypatch.setattr(drawing, "png", save)
    return figures


def assert_all_letters_are_seen(figure: Figure) -> None:
    figure.draw_without_rendering()
    # Matplotlib keeps labels of ticks beyond the axes, and does not draw them
    ticks = {label for axes in figure.axes for label in (*axes.get_xticklabels(), *axes.get_yticklabels())}
    slack = 0.04 * figure.dpi
    for text in set(figure.findobj(Text)) - ticks:
        assert isinstance(text, Text)
        if text.get_visible() and text.get_text():
            box, room = text.get_window_extent(), figure.bbox
            assert min(box.x0, box.y0) >= -slack, text
            assert box.x1 <= room.x1 + slack, text
            assert box.y1 <= room.y1 + slack, text


@pytest.mark.parametrize("name", ["lr $1e-3 _ $", r"A $\foo$", "$x^2$"])
def test_dollar_signs_in_names_are_letters(tmp_path: Path, drawn: list[Figure], name: str) -> None:
    """In pairs, Matplotlib reads them as mathematics."""
    settings = [{f"noise {name}": value} for value in (name, "0.1")]
    study = read_study(write_study(tmp_path / "mine", runs(lambda *run: float(run[2]), [name], settings, range(2), [name])))
    drawing.sensitivity(study, name)
    drawing.stability(score_table([study]), study.methods, 10)
    drawing.values(study, score_table([study]), name, 10)
    drawing.final_rewards(study, score_table([study]), 10)
    assert learning_curves.curves_by_steps(study, name, 10)
    assert len(drawn) == 4
    assert not any(text.get_parse_math() for figure in drawn for text in figure.findobj(Text) if isinstance(text, Text))


@pytest.mark.parametrize("methods", [["CGP-Online"], [LONG], [LONG, f"{LONG} of letters"]])
@pytest.mark.parametrize("configurations", AXES)
def test_no_letters_are_cut_off_however_few_methods_there_are(
    tmp_path: Path, drawn: list[Figure], methods: list[str], configurations: list[dict[str, Any]]
) -> None:
    records = runs(lambda method, settings, seed: 100.0 * seed, methods, configurations, range(2), ["Pendulum-v1"])
    study = read_study(write_study(tmp_path / "mine", records))
    drawing.sensitivity(study, "Pendulum-v1")
    drawing.stability(score_table([study]), study.methods, 10)
    drawing.values(study, score_table([study]), "Pendulum-v1", 10)
    drawing.final_rewards(study, score_table([study]), 10)
    assert len(drawn) == 4
    for figure in drawn:
        assert_all_letters_are_seen(figure)
    titles = [axes.title.get_window_extent() for axes in drawn[0].axes if axes.get_title()]
    assert len(titles) == len(methods)
    assert all(one.x1 < other.x0 for one, other in itertools.pairwise(titles))


def test_a_figure_that_cuts_nothing_is_saved_as_it_is() -> None:
    def draw() -> Figure:
        figure, (panel,) = panels(1, size=(3.7, 2.9))
        panel.plot([0, 1], [0, 1], label="CGP-Online")
        legend(figure, [panel], "Pendulum-v1")
        return figure

    expected = io.BytesIO()
    draw().savefig(expected, format="png", dpi=120, pil_kwargs={"optimize": True})
    assert png(draw()) == expected.getvalue()
