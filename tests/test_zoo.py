"""CGP in rl_zoo3: registration, the YAML file, and Optuna's search space."""

import argparse
import importlib
import inspect
import sys
import warnings
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import optuna
import pytest
import yaml
from environments import Reach
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from optuna.distributions import CategoricalDistribution
from optuna.trial import FixedTrial
from rl_zoo3 import exp_manager, hyperparams_opt, utils
from rl_zoo3.exp_manager import ExperimentManager
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.envs import BitFlippingEnv

from sb3_cgp import CGP
from sb3_cgp.resumption.callbacks import TrainingCheckpointCallback
from sb3_cgp.zoo import folders
from sb3_cgp.zoo import registration as zoo
from sb3_cgp.zoo.checkpoints import without_checkpoints
from sb3_cgp.zoo.search_space import VARIANTS

PAPER_TASKS = {f"{task}-v{version}" for task in ("HalfCheetah", "Humanoid", "Hopper", "Pusher", "Ant") for version in (4, 5)}
OTHER_TASKS = {"Pendulum-v1", "MountainCarContinuous-v0"} | {
    f"{task}-v{version}"
    for task in ("InvertedPendulum", "InvertedDoublePendulum", "Reacher", "Swimmer", "Walker2d")
    for version in (4, 5)
}
# Packages that need not be installed, by their tasks
PACKAGE_TASKS = {
    "Box2D": {"LunarLanderContinuous-v3", "BipedalWalker-v3"},
    "panda_gym": {f"Panda{task}-v3" for task in ("Reach", "Push", "Slide", "PickAndPlace", "Stack")},
    "gymnasium_robotics": {f"Fetch{task}-v4" for task in ("Reach", "Push", "Slide", "PickAndPlace")},
}
GOAL_TASKS = PACKAGE_TASKS["panda_gym"] | PACKAGE_TASKS["gymnasium_robotics"]
OTHER_TASKS |= set.union(*PACKAGE_TASKS.values())
ENTRIES = yaml.safe_load((zoo.hyperparams_folder() / "cgp.yml").read_text())
NO_HER = {"using_her_replay_buffer": False, "her_kwargs": {}}
TINY = {"buffer_size": 100, "policy_kwargs": {"net_arch": [4]}}


def manager(folder, algo="cgp", env_id="Pendulum-v1", **kwargs) -> ExperimentManager:
    """What ``rl_zoo3.train`` makes of its arguments."""
    args = argparse.Namespace()
    return ExperimentManager(args, algo, env_id, str(folder), eval_freq=-1, verbose=0, device="cpu", **kwargs)


def random_parameters(n_trials: int, additional_args=NO_HER) -> list[dict]:
    """What Optuna suggests in independent trials."""
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    trials = [study.ask() for _ in range(n_trials)]
    for trial in trials:
        zoo.sample_cgp_params(trial, 1, 1, additional_args)
    return [trial.params for trial in trials]


@pytest.fixture
def unregistered(monkeypatch):
    """rl_zoo3 as it is without us, where the start-up hook or another test has registered CGP."""
    zoo.register()
    for registry in (utils.ALGOS, hyperparams_opt.HYPERPARAMS_SAMPLER, hyperparams_opt.HYPERPARAMS_CONVERTER):
        monkeypatch.delitem(registry, "cgp")
    for name in ("__init__", "create_callbacks", "_preprocess_hyperparams", "learn", "save_trained_model"):
        monkeypatch.setattr(ExperimentManager, name, getattr(ExperimentManager, name).__wrapped__)


def test_register_adds_cgp_and_nothing_else(unregistered, tmp_path):
    registries = (utils.ALGOS, hyperparams_opt.HYPERPARAMS_SAMPLER, hyperparams_opt.HYPERPARAMS_CONVERTER)
    before = [dict(registry) for registry in registries]
    assert not Path(manager(tmp_path).config).exists()

    zoo.register()

    added = [CGP, zoo.sample_cgp_params, zoo.convert_cgp_params]
    assert [dict(registry) for registry in registries] == [old | {"cgp": new} for old, new in zip(before, added, strict=True)]
    # Scripts hold the dictionaries by other names
    assert exp_manager.ALGOS["cgp"] is CGP
    assert Path(manager(tmp_path).config) == zoo.hyperparams_folder() / "cgp.yml"


def test_register_twice_is_register_once(unregistered):
    zoo.register()
    initialise = ExperimentManager.__init__
    zoo.register()
    assert ExperimentManager.__init__ is initialise


def test_default_config_of_other_algorithms_and_a_config_given_are_kept(tmp_path):
    zoo.register()
    assert Path(manager(tmp_path, "td3").config) == Path(exp_manager.__file__).parent / "hyperparams" / "td3.yml"
    assert manager(tmp_path, config="mine.yml").config == "mine.yml"
    positions = list(inspect.signature(ExperimentManager).parameters)
    arguments = {"args": argparse.Namespace(), "algo": "cgp", "env_id": "Pendulum-v1", "log_folder": "", "config": "mine.yml"}
    defaults = inspect.signature(ExperimentManager).parameters
    positional = [arguments.get(name, defaults[name].default) for name in positions[: positions.index("config") + 1]]
    assert ExperimentManager(*positional).config == "mine.yml"


def test_hyperparams_folder_inside_the_package_or_beside_it(monkeypatch, tmp_path):
    package = tmp_path / "sb3_cgp"
    monkeypatch.setattr(folders, "__file__", str(package / "zoo" / "folders.py"))
    with pytest.raises(FileNotFoundError, match="install sb3_cgp again"):
        folders.hyperparams_folder()
    for folder in (tmp_path / "hyperparams", package / "hyperparams"):
        folder.mkdir(parents=True)
        (folder / "cgp.yml").touch()
        assert folders.hyperparams_folder() == folder


def test_push_to_hub_starts_and_writes_a_model_card(tmp_path):
    zoo.register()
    push_to_hub = importlib.import_module("rl_zoo3.push_to_hub")
    card, metadata = push_to_hub.generate_model_card("cgp", "CGP", "me", "Pendulum-v1", -150.0, 10.0, {}, {})
    push_to_hub.save_model_card(tmp_path, card, metadata)
    front_matter = yaml.safe_load((tmp_path / "README.md").read_text().split("---")[1])
    assert front_matter["model-index"][0]["name"] == "CGP"
    assert front_matter["model-index"][0]["results"][0]["metrics"][0]["value"] == "-150.00 +/- 10.00"


def test_a_hub_library_that_is_whole_is_left_alone(monkeypatch):
    hub = importlib.import_module("huggingface_sb3.push_to_hub")
    theirs = object()
    monkeypatch.setattr(hub, "generate_metadata", theirs, raising=False)
    zoo.register()
    assert hub.generate_metadata is theirs


def test_the_default_entry_is_the_default_of_cgp():
    entry = {**ENTRIES["default"]}
    assert entry.pop("n_timesteps") == 1e6
    assert entry.pop("policy") == "MlpPolicy"
    assert entry.pop("policy_kwargs") == "dict(net_arch=[256, 256])"
    assert entry.pop("callback") == [{"sb3_cgp.TrainingCheckpointCallback": {"save_freq": 10_000}}]
    assert CGP("MlpPolicy", "Pendulum-v1", buffer_size=1).policy.net_arch == [256, 256]
    defaults = {name: parameter.default for name, parameter in inspect.signature(CGP).parameters.items()}
    assert entry == {name: defaults[name] for name in entry}


def test_the_light_entry_is_the_default_but_for_cem():
    entries = yaml.safe_load((zoo.hyperparams_folder() / "cgp_light.yml").read_text())
    assert entries == {"default": ENTRIES["default"] | dict(cem_start="actor", cem_iterations=1, cem_samples=16)}


def test_a_run_takes_the_light_entry(tmp_path):
    zoo.register()
    model, _ = manager(tmp_path, config=str(zoo.hyperparams_folder() / "cgp_light.yml"), hyperparams=TINY).setup_experiment()
    assert repr(model.policy.selector).startswith("ActorCEM(iterations=1, samples=16, elites=6")


def test_every_task_has_its_entry_and_the_papers_tasks_its_configuration():
    assert set(ENTRIES) == {"default"} | PAPER_TASKS | OTHER_TASKS
    for task in PAPER_TASKS:
        assert ENTRIES[task] | {"n_timesteps": None} == ENTRIES["default"] | {"n_timesteps": None}


@pytest.mark.filterwarnings("ignore:.*out of date")
@pytest.mark.parametrize("env_id", sorted(set(ENTRIES) - {"default"}))
def test_every_entry_builds_a_model(env_id, tmp_path):
    if env_id == "Pusher-v4":
        pytest.skip("needs mujoco<3")
    for package, tasks in PACKAGE_TASKS.items():
        if env_id in tasks:
            pytest.importorskip(package, reason=f"{package} is not installed")
    zoo.register()
    model, saved = manager(tmp_path, env_id=env_id, hyperparams={"buffer_size": 100}).setup_experiment()
    assert isinstance(model, CGP)
    assert model.gamma == ENTRIES[env_id]["gamma"]
    assert model.policy.net_arch == eval(ENTRIES[env_id]["policy_kwargs"])["net_arch"]
    assert (model.action_noise is not None) == ("noise_type" in saved)
    assert (model.replay_buffer_class is HerReplayBuffer) == (env_id in GOAL_TASKS)


@pytest.mark.parametrize("env_id", sorted(GOAL_TASKS))
def test_every_entry_of_goals_is_one_that_a_goal_environment_trains_by(env_id, tmp_path, monkeypatch):
    """Without the task's package."""
    monkeypatch.setitem(gym.registry, "Reach-v0", EnvSpec("Reach-v0", entry_point=Reach, max_episode_steps=12))
    (tmp_path / "reach.yml").write_text(yaml.safe_dump({"Reach-v0": ENTRIES[env_id]}))
    zoo.register()
    small = {"buffer_size": 100, "learning_starts": 30, "batch_size": 4, "policy_kwargs": "dict(net_arch=[4])"}
    experiment = manager(tmp_path, env_id="Reach-v0", config=str(tmp_path / "reach.yml"), hyperparams=small)
    model, _ = experiment.setup_experiment()
    model.learn(34)
    assert (model._n_updates, model.gamma, type(model.replay_buffer)) == (4, 0.95, HerReplayBuffer)
    assert (model.get_vec_normalize_env() is not None) == ENTRIES[env_id].get("normalize", False)


def checkpoints_of(experiment):
    return [callback for callback in experiment.callbacks if isinstance(callback, TrainingCheckpointCallback)]


def test_every_run_saves_states_in_its_folder_several_times(tmp_path):
    zoo.register()
    for entry in ENTRIES.values():
        ((settings,),) = [each.values() for each in entry["callback"]]
        assert settings["save_freq"] <= entry["n_timesteps"] / 10
    experiment = manager(tmp_path, hyperparams=TINY, show_progress=True)
    experiment.setup_experiment()
    (checkpoint,) = checkpoints_of(experiment)
    assert checkpoint.path == f"{tmp_path}/cgp/Pendulum-v1_1/state"
    # rl_zoo3 takes the first for the progress bar
    assert experiment.callbacks.index(checkpoint) == len(experiment.callbacks) - 1


def test_a_folder_that_the_user_chose_is_kept_and_none_is_given_without_a_callback(tmp_path):
    zoo.register()
    callback = [{"sb3_cgp.TrainingCheckpointCallback": {"save_freq": 10, "path": "mine"}}]
    experiment = manager(tmp_path, hyperparams=TINY | {"callback": callback})
    experiment.setup_experiment()
    assert [each.path for each in checkpoints_of(experiment)] == ["mine"]
    experiment = manager(tmp_path, hyperparams=TINY | {"callback": None})
    experiment.setup_experiment()
    assert experiment.callbacks == []


@pytest.mark.parametrize("path", [None, "states"])
def test_trials_of_optuna_save_no_states(path, tmp_path, monkeypatch):
    """Two trials, which could not share a folder, with the callbacks that the file has besides."""
    monkeypatch.chdir(tmp_path)
    # A policy's offline training, which a trial may sample, ends soon
    monkeypatch.setattr("sb3_cgp.core.offline.ROUND", 10)
    zoo.register()
    checkpoint = {"sb3_cgp.TrainingCheckpointCallback": {"save_freq": 10, "path": path}}
    small = TINY | {"learning_starts": 10, "callback": [checkpoint, "sb3_cgp.hparams.HParamsCallback"]}
    options = dict(optimize_hyperparameters=True, n_trials=2, n_timesteps=20, n_evaluations=1, n_eval_episodes=1)
    experiment = manager(tmp_path, hyperparams=small, no_optim_plots=True, **options)
    assert experiment.setup_experiment() is None
    assert experiment.specified_callbacks == ["sb3_cgp.hparams.HParamsCallback"]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        experiment.hyperparameters_optimization()
    assert not [warning for warning in caught if "state of the training" in str(warning.message)]
    assert [path for path in tmp_path.rglob("*") if path.name in ("state", "states")] == []


@pytest.mark.parametrize(
    ("specified", "left"),
    [
        (None, []),
        ("", []),
        ({}, []),
        ("sb3_cgp.TrainingCheckpointCallback", []),
        ({"sb3_cgp.resumption.callbacks.TrainingCheckpointCallback": {"save_freq": 10}}, []),
        ("sb3_cgp.hparams.HParamsCallback", ["sb3_cgp.hparams.HParamsCallback"]),
        (
            [{"sb3_cgp.hparams.HParamsCallback": {}}, "sb3_cgp.TrainingCheckpointCallback"],
            [{"sb3_cgp.hparams.HParamsCallback": {}}],
        ),
    ],
)
def test_checkpoints_are_left_out_of_every_form_of_specified_callbacks(specified, left):
    assert without_checkpoints(specified) == left


# What rl_zoo3's enjoy and record_video replace in models that another version of Python saved
CUSTOM_OBJECTS = {"learning_rate": 0.0, "lr_schedule": lambda _: 0.0, "clip_range": lambda _: 0.0}


@pytest.fixture
def save_with_lost_schedules(monkeypatch, tmp_path):
    """Save a model whose learning rates are functions of a module that is missing when the model is loaded."""

    def save(learning_rate="constant", actor_learning_rate="constant"):
        (tmp_path / "lost_module.py").write_text("def constant(progress_remaining): return 1e-3")
        with monkeypatch.context() as patch:
            patch.syspath_prepend(tmp_path)
            module = importlib.import_module("lost_module")
            rates = dict(learning_rate=learning_rate, actor_learning_rate=actor_learning_rate)
            rates = {name: getattr(module, rate) if isinstance(rate, str) else rate for name, rate in rates.items()}
            model = CGP("MlpPolicy", "Pendulum-v1", seed=0, **TINY, **rates)
            model.save(tmp_path / "model")
        del sys.modules["lost_module"]
        return model, tmp_path / "model"

    return save


def test_custom_objects_of_rl_zoo3_replace_an_actors_schedule_that_cannot_be_loaded(save_with_lost_schedules):
    model, path = save_with_lost_schedules()
    with pytest.raises(ModuleNotFoundError, match="lost_module"):
        CGP.load(path)
    loaded = CGP.load(path, custom_objects=CUSTOM_OBJECTS)
    observations = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)
    assert np.array_equal(loaded.predict(observations)[0], model.predict(observations)[0])
    assert "actor_learning_rate" not in CUSTOM_OBJECTS


def test_an_actors_rate_among_the_users_custom_objects_is_taken(save_with_lost_schedules):
    _, path = save_with_lost_schedules(learning_rate=1e-3)
    loaded = CGP.load(path, custom_objects=CUSTOM_OBJECTS | {"actor_learning_rate": 2e-4})
    assert loaded.actor_learning_rate == 2e-4
    with pytest.raises(ModuleNotFoundError, match="lost_module"):
        CGP.load(path, custom_objects={"clip_range": 0.0})


def test_enjoy_shows_a_model_whose_schedules_cannot_be_loaded(save_with_lost_schedules, monkeypatch, tmp_path, capsys):
    _, path = save_with_lost_schedules()
    run = tmp_path / "logs" / "cgp" / "Pendulum-v1_1"
    run.mkdir(parents=True)
    path.with_suffix(".zip").rename(run / "Pendulum-v1.zip")
    zoo.register()
    arguments = f"enjoy.py --algo cgp --env Pendulum-v1 -f {tmp_path}/logs --no-render -n 3 --custom-objects --device cpu"
    monkeypatch.setattr(sys, "argv", arguments.split())
    importlib.import_module("rl_zoo3.enjoy").enjoy()
    assert "Loading" in capsys.readouterr().out


@pytest.mark.parametrize("n_actions", [1, 6])
def test_converter_rebuilds_what_the_sampler_returned(n_actions):
    rl_zoo3_manager = SimpleNamespace(n_actions=n_actions)
    env = SimpleNamespace(action_space=spaces.Box(-1, 1, (n_actions,)))
    seen = set()
    for parameters in random_parameters(200):
        sampled = zoo.sample_cgp_params(FixedTrial(parameters), n_actions, 1, NO_HER)
        # As `--trial-id` does; rl_zoo3 makes the noise from its type and standard deviation.
        converted = zoo.convert_cgp_params(parameters)
        start = parameters["cem_start"] if converted["policy_loss"] else "prior"
        assert converted["cem_start"] == start
        seen.add((parameters["noise_type"], converted["policy_loss"], converted["policy_training"], start))
        converted = ExperimentManager._preprocess_action_noise(rl_zoo3_manager, converted, {}, env)

        noise, rebuilt_noise = sampled.pop("action_noise"), converted.pop("action_noise")
        assert repr(noise) == repr(rebuilt_noise)
        assert noise().shape == (n_actions,)
        assert sampled == converted
    # Every noise, variant and start of CEM was among them.
    assert len(seen) == 3 * (4 * 2 + 1)


def test_no_noise_takes_back_the_noise_of_a_yaml_entry(tmp_path):
    zoo.register()
    parameters = random_parameters(1)[0] | {"noise_type": "none", "noise_std": 0.3}
    sampled = zoo.sample_cgp_params(FixedTrial(parameters), 1, 1, NO_HER)
    hyperparams = zoo.convert_cgp_params(parameters) | TINY
    model, _ = manager(tmp_path, env_id="MountainCarContinuous-v0", hyperparams=hyperparams).setup_experiment()
    assert np.all(model.action_noise() == 0)
    assert np.all(sampled["action_noise"]() == 0)


def test_with_her_the_goals_are_sampled_and_the_rest_is_kept():
    additional_args = {"using_her_replay_buffer": True, "her_kwargs": {"copy_info_dict": True, "n_sampled_goal": 99}}
    (parameters,) = random_parameters(1, additional_args)
    sampled = zoo.sample_cgp_params(FixedTrial(parameters), 1, 1, additional_args)
    converted = zoo.convert_cgp_params(parameters)
    goals = {name: parameters[name] for name in ("n_sampled_goal", "goal_selection_strategy")}
    assert converted["replay_buffer_kwargs"] == goals
    assert sampled["replay_buffer_kwargs"] == goals | {"copy_info_dict": True}
    env = BitFlippingEnv(n_bits=3, continuous=True)
    model = CGP("MultiInputPolicy", env, replay_buffer_class=HerReplayBuffer, **sampled | TINY)
    assert model.replay_buffer.n_sampled_goal == parameters["n_sampled_goal"]


def corners() -> list[dict]:
    """The parameters of a trial at the lowest and at the highest of every range, once for each variant."""
    trial = optuna.create_study().ask()
    zoo.sample_cgp_params(trial, 1, 1, NO_HER)
    ranges = {name: d for name, d in trial.distributions.items() if not isinstance(d, CategoricalDistribution)}
    ends = [{name: getattr(distribution, end) for name, distribution in ranges.items()} for end in ("low", "high")]
    return [trial.params | end | {"variant": variant} for end in ends for variant in VARIANTS]


@pytest.mark.parametrize("parameters", corners() + random_parameters(50))
def test_every_sample_constructs(parameters):
    trial = FixedTrial(parameters)
    hyperparams = zoo.sample_cgp_params(trial, 1, 1, NO_HER)
    # An entry's way to infer must not outlive its actor.
    model = CGP("MlpPolicy", "Pendulum-v1", **{"inference": "averaged_actor"} | hyperparams | TINY)
    assert model.inference == ("cem" if model.policy_loss is None else "averaged_actor")
    assert (model.cem_samples, model.cem_elites) == (trial.user_attrs["cem_samples"], trial.user_attrs["cem_elites"])
