"""What ``make train`` decides before rl_zoo3 starts."""

from pathlib import Path

import pytest

from benchmark import plan


@pytest.mark.parametrize(
    ("steps", "interval"), [(1, 1), (19, 1), (5_000, 250), (60_000, 3_000), (200_000, 10_000), (1_000_000, 10_000)]
)
def test_interval_is_a_twentieth_of_the_run_within_bounds(steps: int, interval: int) -> None:
    assert plan.evaluation_interval(steps) == interval


def test_length_comes_from_the_yaml_file_when_none_is_asked_for() -> None:
    # rl_zoo3's own tuned TD3 trains for 20,000 steps
    assert plan.planned_interval("td3", "Pendulum-v1", steps=None) == 1_000
    assert plan.planned_interval("td3", "Pendulum-v1", steps=400) == 20


def test_unregistered_environment_is_left_for_rl_zoo3_to_refuse() -> None:
    assert plan.planned_interval("td3", "NoSuchEnv-v0", steps=None) == plan.LONGEST_INTERVAL


def test_next_run_follows_the_latest(tmp_path: Path) -> None:
    assert plan.next_run_id(str(tmp_path), "cgp", "Pendulum-v1") == 1
    (tmp_path / "cgp" / "Pendulum-v1_7").mkdir(parents=True)
    assert plan.next_run_id(str(tmp_path), "cgp", "Pendulum-v1") == 8


def test_prints_one_line_for_the_makefile(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plan.main(["--algo", "td3", "--folder", str(tmp_path)])
    assert capsys.readouterr().out == "1000 1\n"


@pytest.mark.parametrize("steps", ["0", "-5", "many"])
def test_refuses_a_length_that_is_none(steps: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        plan.main([f"--steps={steps}"])
    assert f"argument --steps: '{steps}' is not an integer >= 1" in capsys.readouterr().err
