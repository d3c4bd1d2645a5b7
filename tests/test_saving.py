"""CGP's models saved and loaded: the same arguments, parameters and training."""

import inspect
import io
import json
import tempfile
import warnings
import zipfile

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from small_models import make_model, same_parameters
from stable_baselines3 import TD3
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.td3.policies import TD3Policy

from sb3_cgp import CEM, CGP, CGPPolicy, CnnPolicy, MultiInputPolicy


def test_loading_changes_arguments_and_checks_them(tmp_path):
    model = make_model().learn(100)
    model.save(tmp_path / "model")
    loaded = CGP.load(tmp_path / "model", cem_iterations=4, cem_elites=3)
    assert (loaded.policy.selector.iterations, loaded.policy.selector.elites) == (4, 3)
    with pytest.raises(ValueError, match="`tau` is -3"):
        CGP.load(tmp_path / "model", tau=-3)
    with pytest.raises(ValueError, match="`policy_delay` is 'banana', but must be an integer >= 1"):
        CGP.load(tmp_path / "model", policy_delay="banana")
    assert CGP.load(tmp_path / "model", inference=None).policy.inference == "actor"
    # As rl_zoo3's enjoy does
    assert CGP.load(tmp_path / "model", custom_objects=dict(learning_rate=0.0, lr_schedule=lambda _: 0.0))
    # The actor's own rate, where one is given beside it
    rates = dict(learning_rate=0.0, actor_learning_rate=2e-3)
    assert CGP.load(tmp_path / "model", custom_objects=rates).actor_lr_schedule(1.0) == 2e-3


@pytest.mark.parametrize(
    ("saved", "loaded", "inference"),
    [
        (dict(), dict(policy_loss=None), "cem"),
        (dict(policy_loss=None), dict(policy_loss="cgp"), "actor"),
        (dict(policy_loss=None), dict(policy_loss="qgp"), "actor"),
        (dict(policy_loss=None), dict(policy_loss="cgp", policy_training="offline"), "cem"),
        (dict(inference="averaged_actor"), dict(policy_loss="qgp"), "averaged_actor"),
        (dict(inference="averaged_actor"), dict(inference=None), "actor"),
    ],
    ids=str,
)
def test_defaults_that_depend_on_other_arguments_are_resolved_when_loading(saved, loaded, inference, tmp_path):
    make_model(**saved).save(tmp_path / "model")
    model = CGP.load(tmp_path / "model", env=gym.make("Pendulum-v1"), **loaded)
    assert model.policy.inference == inference
    assert model.inference == loaded.get("inference", saved.get("inference"))
    # What it resolves to is saved as an argument no more than before
    model.save(tmp_path / "again")
    assert CGP.load(tmp_path / "again").inference == model.inference


def test_n_step_returns_obey_the_arguments_of_load(tmp_path):
    model = make_model(n_steps=3, gamma=0.99).learn(60)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    for n_steps, gamma in ((3, 0.5), (2, 0.99), (1, 0.9)):
        with warnings.catch_warnings():
            # No warning that `n_steps` is ignored
            warnings.simplefilter("error")
            loaded = CGP.load(tmp_path / "model", gym.make("Pendulum-v1"), n_steps=n_steps, gamma=gamma).learn(60)
        assert getattr(loaded.replay_buffer, "n_steps", 1) == n_steps
        assert getattr(loaded.replay_buffer, "gamma", gamma) == gamma
    # A buffer that was saved with other ones
    loaded = CGP.load(tmp_path / "model", gym.make("Pendulum-v1"), gamma=0.5)
    loaded.load_replay_buffer(tmp_path / "buffer")
    loaded.learn(10, reset_num_timesteps=False)
    assert set(loaded.replay_buffer.sample(64).discounts.flatten().tolist()) <= {0.5, 0.5**2, 0.5**3}
    # An attribute that changes between two trainings
    loaded.gamma = 0.25
    loaded.learn(10, reset_num_timesteps=False)
    assert loaded.replay_buffer.gamma == 0.25


@pytest.mark.parametrize(
    ("saved", "loaded", "message"),
    [
        (dict(), dict(n_steps=3), "`replay_buffer` is 'ReplayBuffer', but must be a NStepReplayBuffer"),
        (dict(n_steps=3), dict(n_steps=1), "`replay_buffer` is 'NStepReplayBuffer', but must be a ReplayBuffer"),
        (
            dict(replay_buffer_kwargs=dict(handle_timeout_termination=False)),
            dict(optimize_memory_usage=True),
            "`replay_buffer.optimize_memory_usage` is False, but must be True",
        ),
        (
            dict(),
            dict(replay_buffer_kwargs=dict(handle_timeout_termination=False)),
            "`replay_buffer.handle_timeout_termination` is True, but must be False",
        ),
    ],
    ids=str,
)
def test_a_loaded_buffer_that_contradicts_the_arguments_is_refused(saved, loaded, message, tmp_path):
    model = make_model(**saved).learn(60)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    other = CGP.load(tmp_path / "model", gym.make("Pendulum-v1"), **loaded)
    with pytest.raises(ValueError, match=message):
        other.load_replay_buffer(tmp_path / "buffer")
    # It learns with a buffer of its own
    assert other.replay_buffer is None
    other.learn(60)
    same = CGP.load(tmp_path / "model", gym.make("Pendulum-v1"))
    same.load_replay_buffer(tmp_path / "buffer")
    assert same.learn(10, reset_num_timesteps=False).replay_buffer.pos == 70


def test_what_sb3_chooses_is_not_stored_in_the_arguments(tmp_path):
    kwargs = {}
    model = make_model(n_steps=3, replay_buffer_kwargs=kwargs)
    assert (model.replay_buffer_class, model.replay_buffer_kwargs, kwargs) == (None, {}, {})
    model.save(tmp_path / "model")
    loaded = CGP.load(tmp_path / "model", gym.make("Pendulum-v1"), replay_buffer_class=ReplayBuffer, n_steps=1).learn(60)
    assert type(loaded.replay_buffer) is ReplayBuffer


def test_a_loaded_model_allocates_its_buffer_when_it_trains(tmp_path):
    model = make_model(buffer_size=700).learn(100)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = CGP.load(tmp_path / "model", env=gym.make("Pendulum-v1"))
    assert loaded.replay_buffer is None
    assert loaded.buffer_size == 700
    loaded.learn(100)
    assert loaded.replay_buffer.buffer_size == 700
    assert loaded.replay_buffer.size() == 100
    loaded.load_replay_buffer(tmp_path / "buffer")
    assert (loaded.replay_buffer.actions == model.replay_buffer.actions).all()


def test_a_loaded_model_goes_on_like_the_one_that_was_saved(tmp_path):
    model = make_model().learn(100)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = CGP.load(tmp_path / "model")
    loaded.load_replay_buffer(tmp_path / "buffer")
    for each in (model, loaded):
        each.set_random_seed(3)
        each.set_logger(model.logger)
        each.train(gradient_steps=30, batch_size=16)
    assert same_parameters(model, loaded)


@pytest.mark.parametrize("make_file", [io.StringIO, tempfile.NamedTemporaryFile, lambda: None])
@pytest.mark.parametrize("method", ["save", "save_replay_buffer"])
def test_a_file_object_that_sb3_does_not_take_is_refused_as_by_sb3(method, make_file):
    errors = []
    for algorithm in (TD3, CGP):
        model, file = algorithm("MlpPolicy", "Pendulum-v1", buffer_size=10, policy_kwargs=dict(net_arch=[4])), make_file()
        with pytest.raises(TypeError, match=r"parameter has invalid type: expected one of .*BytesIO") as caught:
            getattr(model, method)(file)
        errors.append(str(caught.value).replace(str(file), ""))
    assert errors[0] == errors[1]


def test_get_and_set_parameters():
    model, other = make_model(seed=0).learn(100), make_model(seed=1)
    assert set(model.get_parameters()) == {"policy", "actor.optimizer", "critic.optimizer"}
    other.set_parameters(model.get_parameters())
    assert same_parameters(model, other)


def test_the_saved_file_holds_no_network_twice(tmp_path):
    make_model().learn(100).save(tmp_path / "model.zip")
    data = json.loads(zipfile.ZipFile(tmp_path / "model.zip").read("data"))
    assert data.keys().isdisjoint({"policy", "actor", "actor_target", "critic", "critic_target", "replay_buffer"})
    assert not any("deferred" in key or "actor_lr_schedule" in key for key in data)


@pytest.mark.parametrize("policy_class", [CGPPolicy, CnnPolicy, MultiInputPolicy])
def test_a_policy_saved_alone_keeps_every_argument(policy_class, tmp_path):
    box = spaces.Box(0, 255, (3, 36, 36), np.uint8)
    space = {CGPPolicy: spaces.Box(-1, 1, (3,)), CnnPolicy: box, MultiInputPolicy: spaces.Dict(image=box)}[policy_class]
    policy = policy_class(space, spaces.Box(-2, 2, (2,)), lambda _: 1e-3, net_arch=[8], activation_fn=th.nn.Tanh, n_critics=3,
                          selector=CEM(3, 10, 2), inference="cem", cem_dtype="float32",
                          optimizer_kwargs=dict(weight_decay=0.1))  # fmt: skip
    classes = [each for each in policy_class.__mro__ if issubclass(each, TD3Policy)]
    named = {name for each in classes for name in inspect.signature(each.__init__).parameters} - {"self", "args", "kwargs"}
    assert {"net_arch", "selector", "cem_dtype", "n_critics"} <= named
    assert named <= set(policy._get_constructor_parameters())
    policy.save(tmp_path / "policy")
    loaded = policy_class.load(tmp_path / "policy")
    assert repr(loaded.selector) == "CEM(iterations=3, samples=10, elites=2, result='best')"
    assert loaded.inference == "cem"
    assert loaded.cem_dtype == "float32"
    observation = space.sample()
    th.manual_seed(0)
    action = policy.predict(observation)[0]
    th.manual_seed(0)
    assert np.array_equal(loaded.predict(observation)[0], action)


def test_the_data_type_of_cem_reaches_the_scores_and_can_be_changed_when_loading(tmp_path):
    model = make_model(cem_dtype="bfloat16", policy_kwargs=dict(net_arch=[32, 32]))
    model.save(tmp_path / "model")
    observations = th.randn(64, *model.observation_space.shape)

    def selected(model):
        th.manual_seed(0)
        return model.policy.select_actions(observations, model.critic).actions

    exact = CGP.load(tmp_path / "model", cem_dtype="float32")
    assert (CGP.load(tmp_path / "model").cem_dtype, exact.cem_dtype) == ("bfloat16", "float32")
    assert th.equal(selected(CGP.load(tmp_path / "model")), selected(model))
    assert not th.equal(selected(exact), selected(model))
