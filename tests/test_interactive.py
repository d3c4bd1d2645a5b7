"""Figures to explore in a browser: their numbers, what is switched on and off, and anchors from the literature."""

from dataclasses import replace
from pathlib import Path

import pytest
from finished_studies import record, runs, study

from benchmark.common.records import Record
from benchmark.common.style import METHODS
from benchmark.reporting.interactive import MINUTES, STEPS, figure


def timed(method: str, seed: int, minutes: float | None) -> Record:
    run = record(method, seed, 40.0 + seed, "HalfCheetah-v5", returns=[10.0, 20.0, 30.0, 40.0 + seed])
    return replace(run, processor_seconds=None if minutes is None else 60 * minutes)


def test_each_method_has_its_seeds_its_mean_and_its_band(tmp_path: Path) -> None:
    data = figure(study(tmp_path, [timed("TD3", seed, None) for seed in range(4)]), "HalfCheetah-v5", 50)["data"]
    assert [trace["meta"]["kind"] for trace in data] == ["band", "band", *["seed"] * 4, "mean"]
    assert {trace["legendgroup"] for trace in data} == {"TD3"}
    assert [trace["name"] for trace in data if trace.get("showlegend", True)] == ["TD3"]
    assert [trace["y"][-1] for trace in data[2:]] == [40.0, 41.0, 42.0, 43.0, 41.5]
    assert all(trace["x"] == [250.0, 500.0, 750.0, 1000.0] for trace in data)
    assert data[-1]["line"]["color"] == METHODS["TD3"]["color"]
    assert "TD3, seed 3" in data[5]["hovertemplate"]


def test_one_seed_has_no_band_and_says_so(tmp_path: Path) -> None:
    data = figure(study(tmp_path, [timed("TD3", 0, None)], seeds=[0, 1, 2, 3]), "HalfCheetah-v5", 20)["data"]
    assert [trace["meta"]["kind"] for trace in data] == ["seed", "mean"]
    assert data[-1]["name"] == "TD3 (1 of 4 seeds)"


def test_buttons_change_to_minutes_where_a_time_is_known(tmp_path: Path) -> None:
    chosen = study(tmp_path, [timed("TD3", 0, 8.0), timed("TD3", 1, 12.0), timed("SAC", 0, None)], seeds=[0, 1])
    found = figure(chosen, "HalfCheetah-v5", 20)
    by_steps, by_minutes = found["layout"]["updatemenus"][0]["buttons"]
    places = [trace["x"] for trace in found["data"]]
    assert (by_steps["args"][0]["x"], by_steps["args"][1]["xaxis.title.text"]) == (places, STEPS)
    assert by_minutes["args"][1]["xaxis.title.text"] == MINUTES
    minutes = dict(
        zip([(trace["name"], trace["meta"]["kind"]) for trace in found["data"]], by_minutes["args"][0]["x"], strict=True)
    )
    assert minutes["TD3", "mean"] == pytest.approx([2.5, 5.0, 7.5, 10.0])
    assert minutes["SAC (1 of 2 seeds)", "mean"] == []
    untimed = figure(study(tmp_path, [timed("TD3", 0, None)]), "HalfCheetah-v5", 20)["layout"]["updatemenus"][0]["buttons"]
    assert [button["label"] for button in untimed] == ["by steps"]


def test_seeds_are_hidden_by_a_button(tmp_path: Path) -> None:
    found = figure(study(tmp_path, [timed("TD3", seed, None) for seed in range(2)]), "HalfCheetah-v5", 20)
    for button, opacity in zip(found["layout"]["updatemenus"][1]["buttons"], (0.4, 0.0), strict=True):
        change, numbers = button["args"]
        assert change == {"opacity": opacity}
        assert [found["data"][number]["meta"]["kind"] for number in numbers] == ["seed"] * 2


def test_many_methods_begin_with_four_and_random_actions_are_left_out(tmp_path: Path) -> None:
    records = runs(lambda *_: 1.0, ["CGP-Online", "CGP-Offline", "QGP-Online", "CEM", "TD3", "SAC", "Random"])
    data = figure(study(tmp_path, records), "Pendulum-v1", 20)["data"]
    shown = {trace["name"]: trace["visible"] for trace in data}
    assert [name for name, visible in shown.items() if visible is True] == ["CGP-Online", "TD3", "SAC"]
    assert [name for name, visible in shown.items() if visible == "legendonly"] == ["CGP-Offline", "QGP-Online", "CEM"]


def test_published_returns_are_marked_as_such(tmp_path: Path) -> None:
    found = figure(study(tmp_path, [timed("TD3", 0, 8.0)], steps=100_000), "HalfCheetah-v5", 20)
    anchors = [trace for trace in found["data"] if trace["meta"]["kind"] == "literature"]
    assert [anchor["name"] for anchor in anchors] == [
        f"{method} in the literature, HalfCheetah-{version}, not measured here"
        for method, version in (("TD3", "v1"), ("SAC", "v4"), ("CrossQ", "v4"))
    ]
    assert (anchors[0]["x"], anchors[0]["y"]) == ([60_000, 100_000], [4332, 5514])
    assert anchors[0]["marker"]["symbol"] == "square-open"
    # They have no times
    by_minutes = found["layout"]["updatemenus"][0]["buttons"][1]
    assert by_minutes["args"][0]["x"][-3:] == [[], [], []]
