"""``python -m benchmark.report`` on runs made by rl_zoo3's own training script."""

import json
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from matplotlib.image import imread
from rl_zoo3.train import train
from stable_baselines3 import PPO, TD3
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from benchmark import report
from benchmark.reporting import run_curves, run_reports, zoo_runs
from sb3_cgp import CGP

ENV = "Pendulum-v1"
TINY = ["learning_starts:50", "batch_size:8", "policy_kwargs:dict(net_arch=[8])", "buffer_size:1000"]


def zoo_train(folder: Path, algo: str, *options: str) -> None:
    """Train for two episodes, as ``python -m rl_zoo3.train`` does."""
    argv = ["train", "--algo", algo, "--env", ENV, "-n", "400", "--seed", "3", "--verbose", "0", "-f", str(folder), *options]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", argv)
        train()


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three runs: CGP with evaluations; TD3 with normalisation and environment arguments; TD3 without evaluations."""
    folder = tmp_path_factory.mktemp("runs") / "a folder with spaces"
    zoo_train(folder, "cgp", "--eval-freq", "200", "--eval-episodes", "2", "-params", *TINY)
    zoo_train(folder, "td3", "--eval-freq", "200", "--env-kwargs", "g:2.0", "-params", "normalize:True", *TINY)
    zoo_train(folder, "td3", "--eval-freq", "-1", "-params", *TINY)
    return folder


def run_report(logs: Path, algo: str, exp_id: int) -> dict:
    """Run the command for three episodes with seed 7, and read the record that it writes."""
    command = f"--algo {algo} --env {ENV} --exp-id {exp_id} --episodes 3 --seed 7"
    report.main([*command.split(), "--folder", str(logs)])
    return json.loads((logs / algo / f"{ENV}_{exp_id}" / "report.json").read_text())


def independent_returns(model: CGP | TD3, env: DummyVecEnv | VecNormalize) -> list[float]:
    env.seed(7)
    returns, _ = evaluate_policy(model, env, n_eval_episodes=3, return_episode_rewards=True)
    return returns


def test_figures_are_those_of_an_independent_evaluation(logs: Path) -> None:
    record = run_report(logs, "cgp", exp_id=1)
    env = DummyVecEnv([lambda: Monitor(gym.make(ENV))])
    returns = independent_returns(CGP.load(logs / "cgp" / f"{ENV}_1" / f"{ENV}.zip"), env)
    assert record["final"] == {
        "episodes": 3,
        "seed": 7,
        "mean": pytest.approx(np.mean(returns)),
        "std": pytest.approx(np.std(returns)),
        "returns": pytest.approx(returns),
    }


def test_normalisation_and_environment_arguments_are_those_of_training(logs: Path) -> None:
    record = run_report(logs, "td3", exp_id=1)
    folder = logs / "td3" / f"{ENV}_1"
    env = DummyVecEnv([lambda: Monitor(gym.make(ENV, g=2.0))])
    normalised = VecNormalize.load(str(folder / ENV / "vecnormalize.pkl"), env)
    normalised.training = False
    normalised.norm_reward = False
    returns = independent_returns(TD3.load(folder / f"{ENV}.zip"), normalised)
    assert record["final"]["returns"] == pytest.approx(returns)


def test_record_says_what_ran(logs: Path) -> None:
    record = run_report(logs, "cgp", exp_id=1)
    assert (record["algo"], record["env"], record["seed"], record["steps"]) == ("cgp", ENV, 3, 400)
    assert record["hyperparameters"]["batch_size"] == 8
    # Of PyPI's builds for CUDA, PyTorch alone names the local version
    assert record["versions"]["torch"] in (th.__version__, th.__version__.partition("+")[0])
    assert record["machine"]["torch_threads"] == th.get_num_threads()
    monitored = (logs / "cgp" / f"{ENV}_1" / "0.monitor.csv").read_text().splitlines()
    assert record["seconds_to_last_training_episode"] == pytest.approx(float(monitored[-1].split(",")[2]))


def test_report_shows_the_gradient_steps(logs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record = run_report(logs, "cgp", exp_id=1)
    # One for each step after the random ones
    assert record["gradient_steps"] == 350
    assert "seed 3, after 400 steps, 350 gradient steps\n" in capsys.readouterr().out


def test_report_says_that_nothing_was_learnt(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.warns(UserWarning, match="Nothing is learnt"):
        zoo_train(tmp_path, "cgp", "--eval-freq", "-1", "-params", *TINY[1:], "learning_starts:400")
    assert run_report(tmp_path, "cgp", exp_id=1)["gradient_steps"] == 0
    assert "after 400 steps, no gradient step: nothing was learnt\n" in capsys.readouterr().out


def test_epochs_are_not_taken_for_gradient_steps() -> None:
    model = PPO("MlpPolicy", ENV, n_steps=8, batch_size=8, n_epochs=3, policy_kwargs=dict(net_arch=[4])).learn(8)
    assert run_reports.gradient_steps(model) is None
    assert run_reports.length_in_words({"steps": 8, "gradient_steps": None}) == "8 steps"


def test_curve_is_that_of_the_evaluations(logs: Path) -> None:
    curve = run_report(logs, "cgp", exp_id=1)["curve"]
    saved = np.load(logs / "cgp" / f"{ENV}_1" / "evaluations.npz")
    assert curve["source"] == "evaluations"
    assert curve["timesteps"] == [200, 400]
    assert curve["mean"] == pytest.approx(saved["results"].mean(axis=1))
    assert curve["std"] == pytest.approx(saved["results"].std(axis=1))


def test_curve_without_evaluations_is_that_of_the_training_episodes(logs: Path) -> None:
    curve = run_report(logs, "td3", exp_id=2)["curve"]
    monitored = (logs / "td3" / f"{ENV}_2" / "0.monitor.csv").read_text().splitlines()[2:]
    assert curve["source"] == "training episodes"
    assert curve["timesteps"] == [200, 400]
    assert curve["mean"] == pytest.approx([float(line.split(",")[0]) for line in monitored])


def test_many_training_episodes_are_joined_into_few_points(tmp_path: Path) -> None:
    episodes = run_curves.TRAINING_POINTS * 3
    lines = ['#{"t_start": 0.0, "env_id": "None"}', "r,l,t", *(f"{number},10,{number}" for number in range(episodes))]
    (tmp_path / "0.monitor.csv").write_text("\n".join(lines))
    curve = run_curves.read_curve(tmp_path)
    assert curve.timesteps == list(range(30, episodes * 10 + 1, 30))
    assert curve.mean == list(range(1, episodes, 3))
    assert curve.std == pytest.approx([np.std([0, 1, 2])] * run_curves.TRAINING_POINTS)


def test_nothing_recorded_is_an_empty_curve(tmp_path: Path) -> None:
    assert run_curves.read_curve(tmp_path) == run_curves.Curve("training episodes", [], [], [])
    assert run_curves.training_seconds(tmp_path) is None


def test_picture_is_a_png_of_the_run(logs: Path) -> None:
    run_report(logs, "cgp", exp_id=1)
    folder = logs / "cgp" / f"{ENV}_1"
    picture = imread(folder / "learning_curve.png", format="png")
    assert picture.shape[0] > 400
    assert picture.shape[1] > 600
    assert picture[..., :3].std() > 0.01, "the picture is blank"
    hidden = {path.name for path in folder.glob(".*")}
    # The lock of a run's folder remains when the run has ended
    assert hidden <= {".run-lock"}, "an unfinished file was left behind"


def test_summary_says_how_it_ended_and_where_everything_lies(logs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    final = run_report(logs, "cgp", exp_id=1)["final"]
    printed = capsys.readouterr().out
    folder = logs / "cgp" / f"{ENV}_1"
    assert f"{final['mean']:.1f} ± {final['std']:.1f} over 3 episodes" in printed
    for path in (folder, folder / f"{ENV}.zip", folder / "learning_curve.png", folder / "report.json"):
        assert str(path) in printed
        assert path.exists()


def test_latest_run_is_the_default(logs: Path) -> None:
    assert zoo_runs.find_run(str(logs), "td3", ENV).folder == logs / "td3" / f"{ENV}_2"


def test_a_run_is_found_by_its_folder_too(logs: Path) -> None:
    assert zoo_runs.run_in(logs / "td3" / f"{ENV}_1") == zoo_runs.find_run(str(logs), "td3", ENV, 1)


def test_a_folder_without_a_run_or_a_model_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match=f"Error: {tmp_path} is no folder of a run"):
        report.main(["--run", str(tmp_path)])
    (tmp_path / ENV).mkdir()
    (tmp_path / ENV / "args.yml").touch()
    with pytest.raises(SystemExit, match=f"Error: No trained model in {tmp_path}"):
        report.main(["--run", str(tmp_path)])


@pytest.mark.parametrize(
    ("content", "reason"), [("", "is damaged"), ("- [a", "is damaged"), ("[1, 2]", "is damaged"), ("{env: a}", "lacks algo")]
)
def test_damaged_settings_are_named(tmp_path: Path, content: str, reason: str) -> None:
    (tmp_path / ENV).mkdir()
    settings, config = (tmp_path / ENV / name for name in ("args.yml", "config.yml"))
    (tmp_path / f"{ENV}.zip").touch()
    settings.write_text(content)
    with pytest.raises(SystemExit, match=rf"Error: {settings} {reason}.* or name another run"):
        report.main(["--run", str(tmp_path)])
    settings.write_text(f"{{algo: cgp, env: {ENV}}}")
    config.write_text("[a")
    with pytest.raises(SystemExit, match=f"Error: {config} is damaged"):
        report.main(["--run", str(tmp_path)])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--episodes 0", "argument --episodes: '0' is not an integer >= 1"),
        ("--exp-id -1", "argument --exp-id: '-1' is not an integer >= 0"),
        ("--seed -1", "argument --seed: '-1' is not an integer within [0, 2**32)"),
    ],
)
def test_wrong_numbers_are_named(options: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        report.main(["--folder", str(tmp_path), *options.split()])
    assert message in capsys.readouterr().err


def test_missing_run_names_the_folder_and_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match=r"No run of cgp on Pendulum-v1 in .*cgp: .*`make train ALGO=cgp") as error:
        report.main(["--folder", str(tmp_path)])
    assert str(tmp_path) in str(error.value)


@pytest.mark.parametrize("started", [True, False])
def test_run_without_a_model_names_its_folder_and_what_to_do(tmp_path: Path, started: bool) -> None:
    if started:
        (tmp_path / "cgp" / f"{ENV}_4").mkdir(parents=True)
    with pytest.raises(SystemExit, match=r"No trained model in .*Pendulum-v1_4: wait .* --exp-id"):
        report.main(["--folder", str(tmp_path), "--exp-id", "4"])
