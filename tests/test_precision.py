"""The comparison of data types: overlaps and statistics against counts by hand, and runs that are not repeated."""

import json

import numpy as np
import pytest
import torch as th
from tables import unpadded

from benchmark import environments, precision
from benchmark.speed import elites, precision_runs, precision_tables
from benchmark.values import bias_runs
from sb3_cgp import CEM

COMMON = {"env": "Pendulum-v1", "steps": 10}


def test_overlap_is_the_share_of_common_elites_along_the_first_search():
    th.manual_seed(0)
    seen = []

    def exact(actions):
        seen.append(actions)
        return actions[:, :, 0]

    # The first state is scored alike, the second the other way round, the third likes neither the largest nor the smallest
    def rounded(actions):
        values = actions[:, :, 0]
        return th.stack([values[0], -values[1], -(values[2] - values[2].median()).abs()])

    overlaps = elites.elite_overlaps(CEM(2, samples=10, elites=4), exact, rounded, n_states=3, action_dim=1)
    # Of ten, the four about the fifth are, as elites, the fourth of the largest or none of them
    assert [round(12 * share, 5) in (4.0, 5.0) for share in overlaps] == [True, True]
    assert elites.elite_overlaps(CEM(3, 10, 10), exact, rounded, n_states=3, action_dim=1) == [1.0, 1.0, 1.0]
    # It narrows around what the first one likes
    assert seen[1].mean() > seen[0].mean() + 0.3


def test_statistics_of_two_sets_of_rewards():
    found = precision_tables.compare([1.0, 2.0, 3.0, 4.0], [2.0, 3.0, 4.0, 5.0])
    assert found["difference"] == 1.0
    # Equal variances of 5/3: a standard error of sqrt(5/6), 6 degrees of freedom
    half_width = 2.446912 * np.sqrt(5 / 6)
    assert found["interval"] == pytest.approx((1.0 - half_width, 1.0 + half_width), rel=1e-5)
    assert 0.0 < found["welch_p"] < 1.0
    # All of one below all of the other: 2 of the 70 ways to share out the ranks are as extreme
    assert precision_tables.compare([1.0, 2.0, 3.0, 4.0], [5.0, 6.0, 7.0, 8.0])["mann_whitney_p"] == pytest.approx(2 / 70)


def test_table_says_what_the_records_say():
    def record(dtype, seed, returns, **more):
        return COMMON | {"dtype": dtype, "seed": seed, "returns": returns} | more

    overlaps = [{"critic": [0.99, 0.9]}, {"critic": [0.97, 0.98]}]
    records = [record("float32", seed, [10.0 * seed, 20.0], overlaps=overlaps[seed]) for seed in range(2)]
    records += [record("bfloat16", seed, [100.0, 120.0 + seed]) for seed in range(2)]
    text = unpadded(precision_tables.markdown(records))
    assert "| Pendulum-v1 | 0, 1 | 10 | 12.5 ± 3.5 | 110.2 ± 0.4 | 97.8 (" in text
    assert "| Pendulum-v1 | critic | 98.0% (97.0%) | 94.0% (90.0%) |" in text
    assert "| Pendulum-v1 | 0 / 1 | 10 | - | - | - | - |" in unpadded(precision_tables.markdown([records[0], records[3]]))


def test_runs_are_recorded_as_they_end_and_not_repeated(tmp_path, monkeypatch):
    asked = []

    def run(env_id, dtype, seed, args, argv):
        asked.append((dtype, seed))
        if len(asked) == 3:
            raise KeyboardInterrupt
        return COMMON | {"dtype": dtype, "seed": seed, "returns": [1.0]}

    monkeypatch.setattr(precision_runs, "run", run)
    options = ["--folder", str(tmp_path), "--envs", "Pendulum-v1", "--steps", "10", "--seeds", "5", "6"]
    with pytest.raises(KeyboardInterrupt):
        precision.main(options)
    assert len(list(tmp_path.glob("*.json"))) == 2
    precision.main(options)
    assert asked == [("float32", 5), ("bfloat16", 5), ("float32", 6), ("float32", 6), ("bfloat16", 6)]
    assert "| 5, 6 |" in unpadded((tmp_path / "precision.md").read_text())


@pytest.mark.parametrize("read", [precision_runs.read_records, bias_runs.read_records, environments.read_all])
def test_a_file_that_a_killed_process_left_is_no_record(tmp_path, read):
    (tmp_path / ".partial-12-Pendulum-v1_float32_seed0.json").write_text("{")
    assert read(tmp_path) == []


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "seed0.json, line 1, is no JSON: Expecting value. Move it away"),
        ('{"env": "Pendulum-v1"}', "seed0.json lacks dtype, seed, steps. Move it away"),
        ({"steps": 10}, "holds runs with steps=10: choose another --folder for steps=20000"),
    ],
)
def test_records_that_are_damaged_or_of_another_length_are_refused_before_any_run(
    content, message, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(precision_runs, "run", lambda *args: pytest.fail("it trains"))
    if not isinstance(content, str):
        content = json.dumps(COMMON | {"dtype": "float32", "seed": 7, "returns": [1.0]} | content)
    (tmp_path / "Pendulum-v1_float32_seed0.json").write_text(content)
    with pytest.raises(SystemExit):
        precision.main(["--folder", str(tmp_path)])
    error = capsys.readouterr().err
    assert f"argument --folder: {tmp_path}" in error
    assert message in error


@pytest.mark.parametrize("options", [["--steps", "10"], ["--envs", "Reacher-v5"]])
def test_records_of_the_same_length_and_of_other_environments_stay(options, tmp_path):
    record = COMMON | {"dtype": "float32", "seed": 7, "returns": [1.0]}
    (tmp_path / "Pendulum-v1_float32_seed7.json").write_text(json.dumps(record))
    assert precision.parse(["--folder", str(tmp_path), *options]).folder == tmp_path


def test_a_run_trains_with_its_data_type_and_compares_elites(tmp_path, monkeypatch):
    monkeypatch.setattr(elites, "STATES", 50)
    monkeypatch.setattr(precision_runs, "EPISODES", 2)
    options = ["--folder", str(tmp_path), "--envs", "Pendulum-v1", "--seeds", "3", "--steps", "40"]
    precision.main(options)
    exact, rounded = (
        json.loads((tmp_path / f"Pendulum-v1_{dtype}_seed3.json").read_text()) for dtype in precision_runs.DTYPES
    )
    assert (exact["steps"], exact["gradient_steps"], exact["seed"], len(exact["returns"])) == (40, 36, 3, 2)
    assert set(exact["overlaps"]) == {"critic", "target critic"}
    # Elites at random would share 6 of 64: a critic of few gradient steps is nearly flat
    assert all(0.1 < share <= 1.0 for shares in exact["overlaps"].values() for share in shares)
    assert "overlaps" not in rounded
    assert exact["command"].startswith("python -m benchmark.precision --folder")


@pytest.mark.parametrize(
    ("steps", "expected"), [(20_000, {}), (19_999, {"learning_starts": 1_999}), (300, {"learning_starts": 30})]
)
def test_runs_that_would_be_mostly_random_learn(steps, expected, capsys):
    """Longer ones keep the random steps of the YAML file, which the records of this repository have."""
    assert precision_runs.shortened("Reacher-v5", steps) == {"n_timesteps": steps, **expected}
    assert ("are random, in place of 10,000" in capsys.readouterr().out) == bool(expected)
