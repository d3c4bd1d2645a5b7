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


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (["--uuid"], "`--uuid` .*leave it out"),
        (["-uuid"], "`--uuid` .*leave it out"),
        (["-f", "other"], "`--log-folder other` .*give LOGS=other"),
        (["-fother"], "`--log-folder other` .*give LOGS=other"),
        # As rl_zoo3 reads it
        (["--log-f=other"], "`--log-folder other` .*give LOGS=other"),
        (["--save-freq", "10", "--algo", "sac"], "`--algo sac` .*give ALGO=sac"),
        (["-params", "tau:1", "--env", "Reacher-v5"], "`--env Reacher-v5` .*give ENV=Reacher-v5"),
        (["-optimize"], "`--optimize-hyperparameters` .*call rl_zoo3.train without make"),
    ],
)
def test_a_run_that_would_not_be_found_at_its_end_is_refused_before_it_starts(options: list[str], named: str) -> None:
    with pytest.raises(SystemExit, match=f"^Error: {named}"):
        plan.main(["--", *options])


def test_options_that_leave_the_run_where_it_is_are_passed_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = (
        "--env-kwargs g:2.0 --eval-env-kwargs g:3.0 -P -tb tensorboard --log-interval 5 --optimization-log-path x -tags uuid"
    )
    plan.main(["--folder", str(tmp_path), "--steps", "20000", "--", *options.split()])
    assert capsys.readouterr().out == "1000 1\n"


@pytest.mark.parametrize("steps", [[], ["--steps", "100"]])
@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (None, "cannot be read: No such file"),
        ("Reacher-v5: {policy", "is no mapping of tasks to hyperparameters"),
        ("", "is no mapping of tasks to hyperparameters"),
        ("Reacher-v5: MlpPolicy", "is no mapping of tasks to hyperparameters"),
        ("Pendulum-v1: {n_timesteps: 100}", "Hyperparameters not found for cgp-Reacher-v5"),
        ("Reacher-v5: {policy: MlpPolicy}", "`n_timesteps` among the task's hyperparameters is None"),
        ("Reacher-v5: {n_timesteps: many}", "`n_timesteps` among the task's hyperparameters is 'many'"),
    ],
)
def test_a_file_of_hyperparameters_that_does_not_fit_is_named(
    steps: list[str], text: str | None, problem: str, tmp_path: Path
) -> None:
    conf_file = tmp_path / "mine.yml"
    if text is not None:
        conf_file.write_text(text)
    with pytest.raises(SystemExit, match=f"^Error: .*{problem}"):
        plan.main(["--env", "Reacher-v5", *steps, "--", "-conf", str(conf_file)])
