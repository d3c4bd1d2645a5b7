"""Tuning: configurations scored by several seeds, and the best as an entry of a YAML file that rl_zoo3 takes."""

import argparse
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import optuna
import pytest
import rl_zoo3.train
import yaml
from optuna.samplers import RandomSampler
from optuna.storages import InMemoryStorage
from optuna.trial import TrialState
from rl_zoo3 import ALGOS
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.hyperparams_opt import HYPERPARAMS_SAMPLER
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from torch import nn

from benchmark import tune
from benchmark.sweeps import tune_execution, tuner
from benchmark.sweeps.entries import base_entry, sampled_entry, write_entry
from benchmark.sweeps.scoring import SCORING
from benchmark.sweeps.study_trials import ERROR
from benchmark.sweeps.tuner import Tuner, best_of
from benchmark.sweeps.tuning import ORIGIN, SCORES
from benchmark.sweeps.validation import SweepError
from sb3_cgp.zoo.registration import register

register()

REPOSITORY = Path(__file__).resolve().parent.parent
TINY = ["learning_starts=30", "batch_size=8", "buffer_size=100", "policy_kwargs=dict(net_arch=[8, 8])", "gradient_steps=1"]
TINY_CGP = [*TINY, "cem_samples=8", "cem_elites=2", "cem_iterations=1", "policy_training=online"]


def arguments(*more, algo="td3", tiny=TINY, trials=2, seeds=2):
    command = ["--algo", algo, "--env", "Pendulum-v1", "--steps", "60", "--seeds", str(seeds), "--trials", str(trials)]
    return [*command, "--eval-episodes", "1", "--device", "cpu", "--set", *tiny, *more]


def tuner_of(args, storage, grace=60.0):
    return Tuner(storage, "study", tune.tuning_of(args), grace)


@pytest.fixture
def work(tmp_path, monkeypatch):
    """Tune in this process, which stands for one that its parent has started."""
    monkeypatch.setattr("benchmark.sweeps.run.FINAL_EPISODES", 1)

    def act(*argv, storage=None, grace=60.0, **options):
        storage = storage or InMemoryStorage()
        args = tune.parse(arguments(*argv, "--logs", str(tmp_path), "--parent", str(os.getppid()), **options))
        own = tuner_of(args, storage, grace)
        tune_execution.execute_trials(own, args)
        return own.trials()

    return act


@pytest.fixture
def pretend(monkeypatch):
    """Let runs give what a function of the run says, and note them."""
    runs = []

    def act(score):
        def train(run, folder, report, watch, device):
            runs.append((run.method, run.seed))
            return score(run)

        monkeypatch.setattr(tuner, "train", train)
        return runs

    return act


def samples(algo, task="Pendulum-v1", n_actions=1, her=None):
    """Some trials, with what rl_zoo3's sampler makes of each."""
    study = optuna.create_study(sampler=RandomSampler(seed=0))
    for _ in range(6):
        trial = study.ask()
        more = {"using_her_replay_buffer": her is not None, "her_kwargs": her or {}}
        yield HYPERPARAMS_SAMPLER[algo](trial, n_actions, 1, more), trial.params


@pytest.mark.parametrize("algo", ["cgp", "td3", "ddpg", "sac", "tqc", "ppo", "a2c", "trpo"])
def test_an_entry_says_what_the_sampler_returns(algo):
    base = base_entry(algo, "Pendulum-v1") if algo != "trpo" else {"policy": "MlpPolicy", "n_timesteps": 100}
    for sampled, params in samples(algo):
        entry = sampled_entry(algo, base, params)
        assert yaml.safe_load(yaml.safe_dump(entry)) == entry
        noise = sampled.pop("action_noise", None)
        kinds = {"normal": NormalActionNoise, "ornstein-uhlenbeck": OrnsteinUhlenbeckActionNoise}
        assert type(noise) is kinds.get(entry.get("noise_type"), type(None))
        if noise is not None:
            np.testing.assert_array_equal(noise._sigma, entry["noise_std"])
        assert eval(entry["policy_kwargs"], {"nn": nn}) == sampled.pop("policy_kwargs")
        for name, value in sampled.items():
            assert entry[name] == value, name


@pytest.mark.parametrize("algo", ["cgp", "td3", "sac", "ppo"])
def test_rl_zoo3_makes_a_model_of_an_entry(tmp_path, algo):
    base = base_entry(algo, "Pendulum-v1")
    for _, params in list(samples(algo))[:3]:
        entry = sampled_entry(algo, base, params) | ({} if algo == "ppo" else {"buffer_size": 100})
        write_entry(tmp_path / "mine.yml", "Pendulum-v1", entry, "a sample")
        args = argparse.Namespace()
        conf_file = str(tmp_path / "mine.yml")
        manager = ExperimentManager(args, algo, "Pendulum-v1", str(tmp_path), config=conf_file, verbose=0, device="cpu")
        model, _ = manager.setup_experiment()
        assert isinstance(model, ALGOS[algo])
        assert model.gamma == entry["gamma"]
        assert (getattr(model, "action_noise", None) is None) == ("noise_type" not in entry)


@pytest.mark.parametrize("algo", ["cgp", "sac", "td3"])
def test_suggestions_for_hindsight_come_beside_what_the_entry_has(algo):
    base = {"policy": "MultiInputPolicy", "replay_buffer_class": "HerReplayBuffer"}
    for kwargs in ("dict(copy_info_dict=True, n_sampled_goal=9)", {"copy_info_dict": True}):
        for sampled, params in samples(algo, her={"copy_info_dict": True}):
            entry = sampled_entry(algo, base | {"replay_buffer_kwargs": kwargs}, params)
            assert eval(entry["replay_buffer_kwargs"]) == sampled["replay_buffer_kwargs"]
            assert "n_sampled_goal" not in entry


def test_no_noise_takes_the_bases_noise_away():
    base = {"policy": "MlpPolicy", "noise_type": "normal", "noise_std": 0.1}
    params = next(params for _, params in samples("td3") if params["noise_type"] is None)
    assert not sampled_entry("td3", base, params).keys() & {"noise_type", "noise_std"}


OTHERS = """# What this file is
Ant-v5: &ant  # the ant
  gamma: 0.98

# About the pendulum

Pendulum-v1:
  gamma: 0.9
  # of the rate
  learning_rate: !!float 1e-3

# About the hopper
Hopper-v5:
  <<: *ant
"""


def test_an_entry_is_replaced_and_nothing_else(tmp_path):
    path = tmp_path / "mine.yml"
    path.write_text(OTHERS)
    write_entry(path, "Pendulum-v1", {"gamma": 0.5, "policy_kwargs": "dict(net_arch=[8])"}, "tuned")
    old = OTHERS[OTHERS.index("Pendulum-v1") : OTHERS.index("\n\n# About the hopper")]
    new = "Pendulum-v1:\n  # tuned\n  gamma: 0.5\n  policy_kwargs: dict(net_arch=[8])"
    assert path.read_text() == OTHERS.replace(old, new)
    write_entry(path, "Pendulum-v1", {"gamma": 0.6}, "tuned again")
    assert path.read_text() == OTHERS.replace(old, "Pendulum-v1:\n  # tuned again\n  gamma: 0.6")


def test_a_link_stays_one_and_lines_end_as_they_did(tmp_path):
    (tmp_path / "real.yml").write_bytes(b"# Mine\r\nAnt-v5:\r\n  gamma: 0.9\r\n")
    (tmp_path / "mine.yml").symlink_to("real.yml")
    write_entry(tmp_path / "mine.yml", "Hopper-v5", {"gamma": 0.5}, "tuned")
    assert (tmp_path / "mine.yml").is_symlink()
    assert (tmp_path / "real.yml").read_bytes() == (
        b"# Mine\r\nAnt-v5:\r\n  gamma: 0.9\r\nHopper-v5:\r\n  # tuned\r\n  gamma: 0.5\r\n"
    )


@pytest.mark.parametrize("before", [None, "", "# Nothing yet\n", OTHERS, OTHERS.rstrip("\n")])
def test_an_entry_is_added(tmp_path, before):
    path = tmp_path / "folder" / "mine.yml"
    if before is not None:
        path.parent.mkdir()
        path.write_text(before)
    write_entry(path, "Reacher-v5", {"gamma": 0.5}, "tuned")
    kept = "" if not before else before.rstrip("\n") + "\n"
    assert path.read_text() == kept + "Reacher-v5:\n  # tuned\n  gamma: 0.5\n"


@pytest.mark.parametrize("before", [OTHERS, "{Ant-v5: {gamma: 1}, Hopper-v5: {gamma: 2}}\n", "- a\n- list\n", "a: [\n"])
def test_a_file_that_cannot_be_changed_is_left_alone(tmp_path, before):
    path = tmp_path / "mine.yml"
    path.write_text(before)
    with pytest.raises(ValueError, match=r"mine.yml is (not changed|no YAML file)"):
        write_entry(path, "Ant-v5", {"gamma": 0.5}, "tuned")
    assert path.read_text() == before


@pytest.mark.parametrize(("algo", "tiny"), [("cgp", TINY_CGP), ("td3", TINY), ("sac", TINY)])
def test_configurations_are_scored_by_several_seeds(work, tmp_path, algo, tiny):
    trials = work(algo=algo, tiny=tiny)
    assert [trial.state for trial in trials] == [TrialState.COMPLETE] * 2, [trial.user_attrs for trial in trials]
    for trial in trials:
        scores = trial.user_attrs[SCORES]
        assert len(set(scores)) == 2
        assert trial.value == np.mean(scores)
        assert trial.intermediate_values == {0: scores[0], 1: np.mean(scores)}
        for seed in (1, 2):
            folder = tmp_path / "study" / f"trial-{trial.number}" / algo / f"Pendulum-v1_{seed}"
            assert 60 <= ALGOS[algo].load(folder / "Pendulum-v1.zip").num_timesteps < 70
            assert not (folder / "state").exists()
    assert best_of(trials).value == max(trial.value for trial in trials)


def test_a_study_goes_on_and_counts_what_is_over(work, pretend):
    runs = pretend(lambda run: float(run.seed))
    storage = InMemoryStorage()
    assert len(work(storage=storage, trials=2)) == 2
    assert len(work(storage=storage, trials=5)) == 5
    assert len(work(storage=storage, trials=5)) == 5
    assert len(runs) == len(set(runs)) == 10


def test_a_failing_configuration_is_recorded_and_the_study_goes_on(work, pretend):
    def score(run):
        if run.method == "trial-1" and run.seed == 1:
            raise FloatingPointError("NaN in the critic")
        return 1.0

    pretend(score)
    trials = work(trials=4)
    assert [trial.state for trial in trials] == [TrialState.COMPLETE, TrialState.FAIL, *[TrialState.COMPLETE] * 2]
    assert trials[1].user_attrs[ERROR] == "FloatingPointError: NaN in the critic"
    assert trials[1].user_attrs[SCORES] == [1.0]
    assert trials[1].params
    assert "1 failed" in tune_execution.describe(trials, 4)


def test_an_impossible_configuration_fails_by_itself(work):
    trials = work(tiny=[*TINY, "tau=minus one"])
    assert [trial.state for trial in trials] == [TrialState.FAIL] * 2
    assert all(trial.user_attrs[ERROR] for trial in trials)
    assert best_of(trials) is None


def test_pruning_by_the_median_of_scores_so_far(work, pretend):
    runs = pretend(lambda run: -float(run.method.split("-")[1]) + run.seed)
    trials = work(trials=8, seeds=3)
    states = [trial.state for trial in trials]
    assert states == [TrialState.COMPLETE] * 5 + [TrialState.PRUNED] * 3
    assert sum(run[0] == "trial-6" for run in runs) == 1
    assert tune_execution.describe(trials, 8) == "8 of 8 configurations over (3 pruned, 0 failed), 0 running, best 1 (trial 0)"


@pytest.mark.parametrize("score", ["mean", "min"])
def test_a_good_first_seed_does_not_save_what_falls_behind(work, pretend, score):
    pretend(lambda run: 0.0 if int(run.method.split("-")[1]) < 5 else 10.0 - 25.0 * run.seed)
    trials = work("--score", score, trials=6, seeds=3)
    assert [trial.state for trial in trials] == [TrialState.COMPLETE] * 5 + [TrialState.PRUNED]
    assert list(trials[5].intermediate_values) == [0, 1]


def test_pruning_by_wilcoxons_test_of_paired_seeds(work, pretend):
    """Seeds differ by more than configurations, as in life; paired, these are told apart."""
    runs = pretend(lambda run: 100.0 * run.seed - float(run.method.split("-")[1]) * (1 + 0.1 * run.seed))
    trials = work("--pruner", "wilcoxon", trials=3, seeds=8)
    assert [trial.state for trial in trials] == [TrialState.COMPLETE, TrialState.PRUNED, TrialState.PRUNED]
    # The fourth seed is the first that can be sure enough
    assert sum(run[0] == "trial-1" for run in runs) == 4
    assert trials[1].intermediate_values == {seed: 100.0 * seed - (1 + 0.1 * seed) for seed in range(4)}


def test_scores():
    returns = [0.0, 10.0, 11.0, 100.0]
    assert {name: score(returns) for name, score in SCORING.items()} == {"mean": 30.25, "iqm": 10.5, "min": 0.0}


def test_a_stopped_configuration_is_taken_up_where_it_was(work, pretend):
    storage, stops = InMemoryStorage(), iter([True])

    def score(run):
        if run.seed == 1 and next(stops, False):
            raise SystemExit(143)
        return float(run.seed)

    runs = pretend(score)
    with pytest.raises(SystemExit):
        work(storage=storage, trials=1)
    (
        stopped,
        again,
    ) = work(storage=storage, trials=1)
    assert (stopped.state, again.state, again.value) == (TrialState.FAIL, TrialState.COMPLETE, 0.5)
    assert again.params == stopped.params
    assert again.user_attrs[ORIGIN] == stopped.number
    # The first seed is not trained again, and the second in the same folder
    assert runs == [("trial-0", 0), ("trial-0", 1), ("trial-0", 1)]


def test_a_configuration_that_is_stopped_while_it_is_suggested_again_stays_whole(work, pretend, tmp_path):
    storage = InMemoryStorage()
    tuner = tuner_of(tune.parse(arguments("--logs", str(tmp_path))), storage)
    (params,) = (params for _, params in list(samples("td3"))[:1])
    tuner._study.enqueue_trial(params, {SCORES: [3.0], ORIGIN: 7})
    trial = tuner._study.ask()
    trial.suggest_float("one_minus_gamma", 0.0001, 0.03, log=True)
    tuner._give_back(trial.number, "given back")
    runs = pretend(lambda run: 1.0)
    again = work(storage=storage, trials=1)[-1]
    assert (again.state, again.params, again.user_attrs[SCORES]) == (TrialState.COMPLETE, params, [3.0, 1.0])
    assert runs == [("trial-7", 1)]


def test_a_lost_configuration_is_taken_up_by_another_process(work, pretend, tmp_path):
    storage = InMemoryStorage()

    class Killed(BaseException):
        pass

    runs = pretend(lambda run: float(run.seed))
    args = tune.parse(arguments("--logs", str(tmp_path)))
    dying = tuner_of(args, storage)
    dying._give_back = lambda *_: None
    scored = tuner.train

    def die(run, *more):
        if run.seed == 1:
            raise Killed
        return scored(run, *more)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tuner, "train", die)
        with pytest.raises(Killed):
            dying.attempt(tmp_path, 5.0, None, "cpu")
    other = tuner_of(args, storage, grace=0.01)
    other.recover()
    time.sleep(0.1)
    other.recover()
    assert [trial.state for trial in other.trials()] == [TrialState.FAIL, TrialState.WAITING]
    lost, again = work(storage=storage, trials=1)
    assert (again.value, again.params) == (0.5, lost.params)
    assert runs == [("trial-0", 0), ("trial-0", 1)]


def test_a_process_that_was_given_up_leaves_the_trial_alone(work, pretend, tmp_path):
    storage = InMemoryStorage()
    args = tune.parse(arguments("--logs", str(tmp_path)))
    tuner = tuner_of(args, storage)

    def score(run):
        if run.seed == 1:
            tuner._give_back(0, "lost: its process fell silent")
        return 1.0

    pretend(score)
    tuner.attempt(tmp_path, 5.0, None, "cpu")
    assert [trial.state for trial in tuner.trials()] == [TrialState.FAIL, TrialState.WAITING]
    assert ERROR not in tuner.trials()[0].user_attrs


def test_a_study_is_not_opened_with_other_settings(work, pretend):
    pretend(lambda run: 1.0)
    storage = InMemoryStorage()
    work(storage=storage)
    with pytest.raises(SweepError, match=r"'study': seeds: was 2 and is now 3.*--study"):
        work(storage=storage, seeds=3)


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["--env", "Pendulum-v0"], "must be a registered environment"),
        (["--conf-file", "others.yml"], "Hyperparameters not found"),
        (["--conf-file", "objects.py"], "The hyperparameters of td3 for Pendulum-v1 are no plain data"),
        (["--storage", "studies.db"], "must be a database's URL"),
        (["--storage", "sqlite://"], "in the memory of one process"),
        (["--study", "my/study"], "must be the name of a folder"),
        (["--env", "no_such_package:Env-v0"], "no_such_package"),
        (["--gym-packages", "no_such_package"], "no_such_package"),
        (["--conf-file", "text.yml"], "target_noise_clip: '5e-1' of the tuned method .td3. is text in YAML"),
        (["--set", "train_freq=[1, stepp]"], "The tuned configurations: no model can be made: .*stepp"),
        (["--algo", "cgp", "--set", "target_policy_noise=-1"], "no model can be made: .*`target_policy_noise`"),
        (["--storage", "postgresql://127.0.0.1:1/x"], r"Error: the storage does not answer: .*127\.0\.0\.1.*continues\."),
    ],
)
def test_mistakes_end_the_command(tmp_path, monkeypatch, argv, message):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("benchmark.sweeps.storages.TABLES_TIMEOUT", 0.0)
    Path("text.yml").write_text("default: {policy: MlpPolicy, n_timesteps: 100, target_noise_clip: 5e-1}")
    Path("others.yml").write_text("Reacher-v5: {gamma: 0.9}")
    Path("objects.py").write_text("hyperparams = {'default': {'policy': object()}}")
    with pytest.raises(SystemExit, match=message):
        tune.main([*arguments(), "--logs", str(tmp_path), *argv])


def test_the_command_writes_what_rl_zoo3_trains(tmp_path, monkeypatch):
    """From the command line, by two processes, to a training by rl_zoo3 with what was found."""
    conf_file = tmp_path / "mine.yml"
    more = ["--workers", "2", "--storage", f"sqlite:///{tmp_path}/studies.db", "--logs", str(tmp_path / "logs")]
    command = [sys.executable, "-m", "benchmark.tune", *arguments(algo="cgp", tiny=TINY_CGP), *more, "--write", str(conf_file)]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False, timeout=600)
    logs = [path.read_text()[-2000:] for path in (tmp_path / "logs").glob("*/worker-*.log")]
    assert done.returncode == 0, (done.stderr, logs)
    study = optuna.load_study(study_name="tune-cgp-Pendulum-v1", storage=f"sqlite:///{tmp_path}/studies.db")
    assert len(study.get_trials(states=[TrialState.COMPLETE])) >= 2
    entry = yaml.safe_load(conf_file.read_text())["Pendulum-v1"]
    assert (entry["batch_size"], entry["n_timesteps"], entry["cem_samples"]) == (8, 60, 8)
    assert entry["gamma"] == 1 - study.best_params["one_minus_gamma"]
    assert f"trial {study.best_trial.number}: mean of 2 seeds" in conf_file.read_text()
    argv = ["train", "--algo", "cgp", "--env", "Pendulum-v1", "--conf-file", str(conf_file), "-f", str(tmp_path / "zoo")]
    monkeypatch.setattr(sys, "argv", [*argv, "--device", "cpu", "--eval-freq", "30", "--eval-episodes", "1"])
    rl_zoo3.train.train()
    model = ALGOS["cgp"].load(tmp_path / "zoo" / "cgp" / "Pendulum-v1_1" / "Pendulum-v1.zip")
    assert 60 <= model.num_timesteps < 70
    assert (model.gamma, model.cem_samples) == (entry["gamma"], 8)


@pytest.mark.parametrize(
    ("options", "random", "is_said"),
    [
        (["--steps", "800"], 80, True),
        (["--steps", "800", "--set", "learning_starts=500"], 500, False),
        # As long as the entry says, or longer
        ([], 10_000, False),
        (["--steps", "30000"], 10_000, False),
    ],
)
@pytest.mark.parametrize("algo", ["cgp", "td3"])
def test_at_most_a_tenth_of_a_shortened_run_is_random(algo, options, random, is_said, capsys):
    tuning = tune.tuning_of(tune.parse(["--algo", algo, "--env", "Pendulum-v1", *options]))
    study = optuna.create_study(sampler=RandomSampler(seed=0))
    tuning.sample(study.ask())
    entry = tuning.entry(study.trials[0])
    assert entry["n_timesteps"] == (int(options[1]) if options else 20_000)
    assert entry["learning_starts"] == random
    assert ("Of the 800 steps, 80 are random" in capsys.readouterr().err) == is_said


class Process:
    """A process that has ended."""

    def poll(self):
        return 0


@pytest.mark.parametrize(
    ("scores", "message"),
    [
        ([1.0, 3.0], None),
        ([1.0], r"All processes have ended too early: .*worker-\*\.log say why\. The same command continues\."),
        ([None, None], r"No configuration was scored: 2 of 2 configurations over \(0 pruned, 2 failed\)"),
    ],
)
def test_the_command_says_how_a_tuning_ended(tmp_path, monkeypatch, capsys, pretend, scores, message):
    """... when its processes, which this one stands for, have ended."""
    storage, left = InMemoryStorage(), iter(scores)
    monkeypatch.setattr(tune, "open_storage", lambda url: storage)
    monkeypatch.setattr("signal.signal", lambda *args: None)

    def score(run):
        value = next(left)
        if value is None:
            raise FloatingPointError("NaN")
        return value

    pretend(score)

    def start_workers(command, n_workers, threads, folder):
        assert command[1:3] == ["-m", "benchmark.tune"]
        assert command[-2:] == ["--parent", str(os.getpid())]
        args = tune.parse(arguments("--logs", str(tmp_path), "--parent", str(os.getppid()), trials=len(scores), seeds=1))
        own = Tuner(storage, "tune-td3-Pendulum-v1", tune.tuning_of(args), 60.0)
        tune_execution.execute_trials(own, args)
        return [Process()]

    monkeypatch.setattr(tune_execution, "start_workers", start_workers)
    argv = arguments("--logs", str(tmp_path), "--write", str(tmp_path / "best.yml"), seeds=1)
    if message is not None:
        with pytest.raises(SystemExit, match=message):
            tune.main(argv)
        return
    tune.main(argv)
    assert "benchmark.tune, trial 1: mean of 1 seeds 3 (3)" in capsys.readouterr().out
    assert yaml.safe_load((tmp_path / "best.yml").read_text())["Pendulum-v1"]["batch_size"] == 8
