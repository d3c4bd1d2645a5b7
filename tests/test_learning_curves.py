"""Learning curves by steps: seeds, interquartile means, legends and published returns."""

from pathlib import Path

import pytest
from drawn_studies import lines, timed
from finished_studies import record, study
from matplotlib.figure import Figure
from tables import unpadded

from benchmark.common.style import METHODS
from benchmark.reporting.figures import draw
from benchmark.reporting.learning_curves import curves_by_steps
from benchmark.reporting.literature import literature_section, published
from benchmark.reporting.scores import Study


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


def test_legend_says_where_seeds_are_missing(tmp_path: Path, drawn: list[Figure]) -> None:
    chosen = study(tmp_path, [*(timed("CGP-Light", seed, None) for seed in range(4)), timed("TD3", 0, None)])
    curves_by_steps(chosen, "Pendulum-v1", 20)
    assert list(lines(drawn[0].axes[0])) == ["CGP-Light", "TD3 (1 of 4 seeds)"]


@pytest.mark.parametrize("number", [2, 4])
def test_legends_fit_on_their_figures(tmp_path: Path, drawn: list[Figure], number: int) -> None:
    methods = ["CGP-Online by CEM", "QGP-Offline", *(f"CGP-Light-{letter}" for letter in "abcdefg")][:number]
    curves_by_steps(study(tmp_path, [timed(method, 0, None) for method in methods], seeds=range(12)), "Pendulum-v1", 20)
    figure = drawn[0]
    figure.draw_without_rendering()
    (legend,) = figure.legends
    assert 0 <= legend.get_window_extent().x0 < legend.get_window_extent().x1 <= figure.bbox.x1
