"""Runs are evaluated in the environment of their ``env_kwargs``, wherever these come from."""

import importlib
import sys

import gymnasium as gym
import numpy as np
import pytest
import yaml
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from rl_zoo3 import ALGOS
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from sweep_populations import write_sweep
from test_resume_zoo import CHECKPOINT, Stop, command, resume, run_of, start
from test_sweep_population import train_together
from test_sweep_run import trained
from trainings import Interruption
from tunings import TINY as TUNED

from benchmark.common.records import EVALUATION_SEED
from benchmark.reporting.zoo_runs import run_in
from benchmark.sweeps.experiments import load_sweep
from benchmark.sweeps.run import run_folder
from sb3_cgp.zoo import registration as zoo

pytestmark = pytest.mark.usefixtures("short_final_evaluation", "short_episodes")

LIGHT = dict(g=1.0, max_episode_steps=7)
# Two more observations
POSITIONS = dict(exclude_current_positions_from_observation=False, max_episode_steps=7)


@pytest.fixture(autouse=True)
def _registered():
    zoo.register()


def lengths(run):
    """Of the evaluations' episodes."""
    with np.load(run / "evaluations.npz") as evaluations:
        return set(evaluations["ep_lengths"].flat)


@pytest.mark.parametrize("algo", ["cgp", "td3"])
@pytest.mark.parametrize(
    ("options", "length"),
    [
        ([], 5),
        (["--env-kwargs", "max_episode_steps:6"], 6),
        (["--eval-env-kwargs", "max_episode_steps:7"], 7),
        (["--env-kwargs", "max_episode_steps:6", "--eval-env-kwargs", "max_episode_steps:7"], 7),
    ],
)
def test_rl_zoo3_evaluates_with_the_arguments_of_the_file_unless_the_command_line_has_others(
    algo, options, length, monkeypatch, tmp_path
):
    entry = dict(n_timesteps=30, policy="MlpPolicy", learning_starts=20, batch_size=8, policy_kwargs="dict(net_arch=[8])")
    (tmp_path / "mine.yml").write_text(yaml.safe_dump({"Pendulum-v1": entry | {"env_kwargs": {"max_episode_steps": 5}}}))
    arguments = f"--algo {algo} --env Pendulum-v1 --log-folder {tmp_path} --eval-freq 15 --conf-file {tmp_path}/mine.yml"
    start(monkeypatch, [*arguments.split(), *options])
    assert lengths(tmp_path / algo / "Pendulum-v1_1") == {length}


@pytest.mark.filterwarnings("ignore:Nothing is learnt", "ignore:Tensorboard log is deactivated")
def test_optuna_scores_trials_with_the_arguments_of_the_file(monkeypatch, tmp_path):
    callback = importlib.import_module("rl_zoo3.exp_manager").TrialEvalCallback
    seen = set()
    monkeypatch.setattr(callback, "_on_training_end", lambda self: seen.update(self.eval_env.get_attr("g")), raising=False)
    options = ["-optimize", "--n-trials", "1", "--n-evaluations", "1", "--no-optim-plots"]
    start(monkeypatch, command(tmp_path, *options, n_timesteps=20, policy_training="'online'", env_kwargs="dict(g=1.0)"))
    assert seen == {1.0}


def test_a_resumed_run_is_evaluated_as_before(monkeypatch, tmp_path):
    callbacks = f"{CHECKPOINT}, 'test_resume_zoo.Stop'"
    monkeypatch.setattr(Stop, "at", 100)
    with pytest.raises(Interruption):
        start(monkeypatch, command(tmp_path, callbacks=callbacks, env_kwargs="dict(max_episode_steps=5)"))
    monkeypatch.setattr(Stop, "at", None)
    resume(run_of(tmp_path))
    assert lengths(run_of(tmp_path)) == {5}


def assert_evaluated_with(env_kwargs, run, folder, final):
    """The final return is that of an evaluation by hand."""
    env = make_vec_env(run.task, env_kwargs=env_kwargs)
    env.seed(EVALUATION_SEED)
    mean, _ = evaluate_policy(ALGOS[run.algo].load(run_in(folder).model_path), env, 2)
    assert final == pytest.approx(mean, rel=1e-3)
    assert lengths(folder) == {7}


@pytest.mark.parametrize(
    ("algo", "task", "env_kwargs"),
    [("cgp", "Pendulum-v1", LIGHT), ("td3", "HalfCheetah-v5", POSITIONS), ("sac", "Pendulum-v1", LIGHT)],
)
def test_a_run_of_a_sweep_is_evaluated_where_it_is_trained(algo, task, env_kwargs, tmp_path):
    path = write_sweep(tmp_path, {"M": (algo, {})}, seeds=[3], tasks=[task], hyperparams={"env_kwargs": env_kwargs})
    (run,) = load_sweep(str(path)).runs()
    folder = run_folder(tmp_path, "study", run)
    final, _ = trained(run, folder, 70)
    assert_evaluated_with(env_kwargs, run, folder, final)


@pytest.mark.parametrize("algo", ["cgp", "td3"])
@pytest.mark.parametrize("stops", [(), (70,)])
def test_a_population_is_evaluated_where_it_is_trained(algo, stops, tmp_path):
    runs = load_sweep(str(write_sweep(tmp_path, {"M": (algo, {})}, hyperparams={"env_kwargs": LIGHT}))).runs()
    finals, _, folders = train_together(runs, tmp_path, *stops)
    for index, (run, folder) in enumerate(zip(runs, folders, strict=True)):
        assert_evaluated_with(LIGHT, run, folder, finals[index])


class Arm(gym.Env):
    """Has as many actions as it is told to."""

    observation_space = spaces.Box(-1, 1, (2,))

    def __init__(self, joints):
        self.action_space = spaces.Box(-1, 1, (joints,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}

    def step(self, action):
        return np.zeros(2, np.float32), 0.0, False, False, {}


@pytest.mark.filterwarnings("ignore:The environment's state cannot", "ignore:The state of EvalCallback's")
@pytest.mark.parametrize("algo", ["cgp", "td3"])
def test_a_tuning_samples_trains_and_evaluates_in_the_environment_of_its_arguments(algo, work, monkeypatch, tmp_path):
    monkeypatch.setitem(gym.registry, "Arm-v0", EnvSpec("Arm-v0", entry_point=Arm))
    conf_file = tmp_path / "arm.yml"
    conf_file.write_text(yaml.safe_dump({"Arm-v0": {"n_timesteps": 60, "policy": "MlpPolicy"}}))
    more = ["env_kwargs={joints: 3, max_episode_steps: 7}", "--env", "Arm-v0", "--conf-file", str(conf_file)]
    (trial,) = work(*more, algo=algo, trials=1, seeds=1, tiny=[*TUNED, "policy_training=online"] if algo == "cgp" else TUNED)
    assert trial.value == 0.0
    (run,) = tmp_path.glob(f"**/{algo}/Arm-v0_1")
    assert lengths(run) == {7}


def test_enjoy_shows_a_run_of_a_sweep_in_its_environment(monkeypatch, tmp_path):
    (run,) = load_sweep(str(write_sweep(tmp_path, {"M": ("td3", {})}, seeds=1, hyperparams={"env_kwargs": LIGHT}))).runs()
    trained(run, run_folder(tmp_path, "study", run))
    enjoy, shown = importlib.import_module("rl_zoo3.enjoy"), []
    make = enjoy.create_test_env
    monkeypatch.setattr(enjoy, "create_test_env", lambda *args, **kwargs: shown.append(make(*args, **kwargs)) or shown[0])
    arguments = f"enjoy.py --algo td3 --env Pendulum-v1 -f {tmp_path}/study/M --no-render -n 3 --device cpu"
    monkeypatch.setattr(sys, "argv", arguments.split())
    enjoy.enjoy()
    assert shown[0].get_attr("g") == [1.0]
