"""``python -m benchmark.bias``: its records, what it refuses, its page and its figure."""

import json
import math

import gymnasium as gym
import pytest
from counting import GAMMA, Counter
from gymnasium import spaces
from tables import unpadded

from benchmark import bias as command
from benchmark.values import bias_page, bias_runs, episodes, methods

TINY = ["--env", "Pendulum-v1", "--steps", "40", "--learning-starts", "10", "--units", "8", "--batch-size", "8"]
TINY += ["--gamma", "0.99", "--interval", "20", "--episodes", "1", "--episode-steps", "460"]


def test_command_records_runs_as_they_end_and_continues(tmp_path, monkeypatch):
    options = [*TINY, "--folder", str(tmp_path), "--methods", "CGP-Light", "TD3", "--seeds", "3", "4"]
    run, asked = bias_runs.run, []

    def interrupted_run(method, seed, args, argv):
        asked.append((method, seed))
        if len(asked) == 3:
            raise KeyboardInterrupt
        return run(method, seed, args, argv)

    monkeypatch.setattr(bias_runs, "run", interrupted_run)
    with pytest.raises(KeyboardInterrupt):
        command.main(options)
    assert len(list(tmp_path.glob("*.json"))) == 2
    command.main(options)
    assert asked == [("CGP-Light", 3), ("TD3", 3), ("CGP-Light", 4), ("CGP-Light", 4), ("TD3", 4)]
    record = json.loads((tmp_path / "Pendulum-v1_CGP-Light_seed4.json").read_text())
    assert record["command"].startswith("python -m benchmark.bias --env Pendulum-v1")
    assert [point["steps"] for point in record["points"]] == [20, 40]
    assert record["points"][1]["actor"]["n_states"] == 2
    assert (tmp_path / "bias.png").read_bytes().startswith(b"\x89PNG")
    assert "| CGP-Light | 3, 4 |" in unpadded((tmp_path / "bias.md").read_text())


def test_command_refuses_other_settings_in_one_folder(tmp_path, capsys):
    options = [*TINY, "--folder", str(tmp_path), "--methods", "TD3", "--seeds", "3"]
    command.main(options)
    with pytest.raises(SystemExit):
        command.main([*options, "--units", "16"])
    assert "holds runs with units=8: choose another --folder for units=16" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "line 1, is no JSON: Expecting value. Move it away"),
        ("{}", "lacks method, seed, settings, points. Move it away"),
        ('{"method": "A", "seed": 0, "settings": {}, "points": []}', "has the method 'A', which must be one of CGP-1"),
        ('{"method": "TD3", "seed": 0, "settings": {"unit": 3}, "points": []}', "holds runs with unit=3"),
    ],
)
def test_command_names_a_damaged_record(content, message, tmp_path, capsys):
    (tmp_path / "Pendulum-v1_TD3_seed0.json").write_text(content)
    with pytest.raises(SystemExit):
        command.main([*TINY, "--folder", str(tmp_path)])
    error = capsys.readouterr().err
    assert f"argument --folder: {tmp_path}" in error
    assert message in error


def test_command_refuses_episodes_too_short_for_a_return(tmp_path, capsys):
    with pytest.raises(SystemExit):
        command.main([*TINY, "--folder", str(tmp_path), "--episode-steps", "458"])
    assert "458 must be at least 459" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            "--steps 150 --interval 200",
            "--interval: 200 must have a multiple above --learning-starts, 10, and not above --steps",
        ),
        (
            "--steps 150 --interval 100 --learning-starts 120",
            "--interval: 100 must have a multiple above --learning-starts, 120",
        ),
        ("--steps 100 --interval 10 --learning-starts 100", "not above --steps, 100, so that something is measured"),
        ("--seeds 0 -1", "argument --seeds: '-1' is not an integer within [0, 2**32)"),
    ],
)
def test_command_refuses_what_measures_nothing_or_cannot_train(options, message, tmp_path, capsys):
    with pytest.raises(SystemExit):
        command.main([*TINY, "--folder", str(tmp_path), *options.split()])
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("gamma", ["1", "0", "nan", "much"])
def test_command_refuses_a_discount_without_a_horizon(gamma, tmp_path, capsys):
    with pytest.raises(SystemExit):
        command.main([*TINY, "--folder", str(tmp_path), "--gamma", gamma])
    assert f"{gamma!r} is not a number above 0 and below 1" in capsys.readouterr().err


def test_command_refuses_observations_of_several_parts(tmp_path, capsys, monkeypatch):
    parts = spaces.Dict(x=Counter.observation_space)
    monkeypatch.setattr(Counter, "observation_space", parts)
    monkeypatch.setitem(gym.registry, "Parts-v0", gym.envs.registration.EnvSpec("Parts-v0", entry_point=Counter))
    with pytest.raises(SystemExit):
        command.main([*TINY, "--folder", str(tmp_path), "--env", "Parts-v0"])
    assert "Parts-v0 must have vectors as observations" in capsys.readouterr().err


def test_page_averages_the_second_half_of_the_training():
    def measured(q1, discounted_return):
        more = {"q_min": q1 - 1.0, "return": 50.0, "length": 10.0, "n_states": 10, "error_bound": 0.25}
        return more | {"q1": q1, "discounted_return": discounted_return}

    def record(seed, late):
        points = [(50, 1000.0), (60, late), (100, late + 2.0)]
        return {
            "method": "TD3",
            "seed": seed,
            "settings": dict(
                env="Env-v0",
                units=8,
                batch_size=9,
                gamma=GAMMA,
                tau=0.5,
                steps=100,
                learning_starts=10,
                episodes=2,
                episode_steps=460,
            ),
            "points": [{"steps": steps, "actor": measured(q1, 10.0)} for steps, q1 in points],
            "command": "python -m benchmark.bias",
            "commit": "abc",
            "versions": {},
            "machine": dict(gpu=None, device="cpu", torch_threads=1, cpu="cpu", cpu_capability="x", cores=1, cem_dtype="y"),
            "load_average": 0.0,
        }

    text = unpadded(bias_page.markdown([record(0, 15.0), record(1, 25.0)]))
    assert "| TD3 | 0, 1 | 11.0 (6.0 to 16.0) | 10.0 (5.0 to 15.0) | 21.0 (16.0 to 26.0) | 10.0 (10.0 to 10.0) |" in text
    assert "the 2 measurements in the second half of 100 steps on Env-v0" in " ".join(text.split())
    assert "no bias by more than 0.25 (0 if" in " ".join(text.split())
    searched = record(2, 15.0)
    searched["points"][-1]["cem"] = measured(1.0, 1.0) | {"error_bound": 0.5}
    # Not in the second half
    searched["points"][0]["cem"] = measured(1.0, 1.0) | {"error_bound": 0.75}
    assert "no bias by more than 0.5 (0 if" in " ".join(bias_page.markdown([record(0, 15.0), searched]).split())


def test_horizon():
    assert episodes.horizon(0.99) == 459
    assert math.isclose(0.5 ** episodes.horizon(0.5), 1 / 128)


def test_figure_has_at_most_four_methods_a_panel_and_every_seed(monkeypatch):
    def run(method, seed):
        values = {"q1": 3.0 + seed, "q_min": 2.0, "discounted_return": 1.0, "return": 5.0 * seed}
        return {"method": method, "seed": seed, "points": [{"steps": steps, "actor": values} for steps in (10, 20)]}

    kept = []
    monkeypatch.setattr(bias_page, "png", lambda figure: kept.append(figure) or b"")
    bias_page.draw([run(method, seed) for method in methods.METHODS for seed in (0, 1)])
    panels = kept[0].axes
    assert len(panels) == 2 * len(bias_page.ROWS)
    assert {method for row in bias_page.ROWS for method in row} == set(methods.METHODS)
    for row, left, right in zip(bias_page.ROWS, panels[::2], panels[1::2], strict=True):
        assert len(row) <= 4
        for panel, low, mean, high in ((left, 2.0, 2.5, 3.0), (right, 0.0, 2.5, 5.0)):
            lines = [line for line in panel.get_lines() if len(line.get_xdata()) == 2 and line.get_xdata()[1] == 20]
            assert [line.get_ydata()[0] for line in lines] == [low, high, mean] * len(row)
        assert sorted(text.get_text() for text in right.texts) == sorted(row)
        assert (left.get_ylim(), right.get_ylim()) == (panels[0].get_ylim(), panels[1].get_ylim())
    bias_page.draw([run("TD3", 0)])
    assert len(kept[1].axes) == 2
