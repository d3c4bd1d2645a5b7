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


def planned(capsys: pytest.CaptureFixture[str], tmp_path: Path, *arguments: str) -> tuple[list[str], str]:
    """The words that the Makefile reads, and the line for the user."""
    plan.main(["--folder", str(tmp_path), *arguments])
    captured = capsys.readouterr()
    return captured.out.split()[2:], captured.err


@pytest.mark.parametrize(("algo", "env"), [("cgp", "Reacher-v5"), ("td3", "Pendulum-v1"), ("cgp", "Swimmer-v5")])
@pytest.mark.parametrize("length", [["--steps", "4000"], ["--", "-n", "4000"]])
def test_at_most_a_tenth_of_a_shortened_run_is_random(algo: str, env: str, length: list[str], capsys, tmp_path: Path) -> None:
    overrides, said = planned(capsys, tmp_path, "--algo", algo, "--env", env, *length)
    assert overrides == ["learning_starts:400"]
    assert said.startswith("Of the 4,000 steps, 400 are random (learning_starts=400), ")
    assert 'PARAMS="learning_starts:..." sets another number' in said


@pytest.mark.parametrize(
    "arguments",
    [
        # The YAML file's length, a longer run, the user's own number, algorithms with few random steps and with none
        [],
        ["--steps", "2000000"],
        ["--steps", "4000", "--", "-params", "batch_size:8", "learning_starts:5000"],
        ["--steps", "4000", "--algo", "sac"],
        ["--steps", "4000", "--algo", "ppo"],
    ],
)
def test_other_runs_keep_their_random_steps(arguments: list[str], capsys, tmp_path: Path) -> None:
    assert planned(capsys, tmp_path, *arguments) == ([], "")


def test_the_plan_is_made_for_the_users_own_hyperparameters(capsys, tmp_path: Path) -> None:
    conf_file = tmp_path / "mine.yml"
    conf_file.write_text("Reacher-v5: {n_timesteps: 4000, policy: MlpPolicy, learning_starts: 300}")
    assert planned(capsys, tmp_path, "--env", "Reacher-v5", "--", "--conf-file", str(conf_file)) == ([], "")
    overrides, _ = planned(capsys, tmp_path, "--env", "Reacher-v5", "--steps", "1000", "--", "--conf-file", str(conf_file))
    assert overrides == ["learning_starts:100"]
    plan.main(["--env", "Reacher-v5", "--folder", str(tmp_path), "--", "-conf", str(conf_file)])
    assert capsys.readouterr().out == "200 1\n"
