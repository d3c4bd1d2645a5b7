"""Exported policies: they act as ``predict`` does, are written whole, and are loaded from data that runs nothing."""

import base64
import builtins
import hashlib
import json
import os
import pickle
import re
import shutil
import struct
import zipfile
from collections import OrderedDict
from pathlib import Path

import gymnasium as gym
import numpy as np
import onnx
import onnxruntime
import pytest
import torch as th
from environments import Reach
from gymnasium import spaces
from safetensors.torch import load_file, save_file
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize
from torch import nn

from sb3_cgp import CGP
from sb3_cgp.common.extras import how_to_install
from sb3_cgp.export import boxes
from sb3_cgp.export import description as exported
from sb3_cgp.export.boxes import describe_box

FILES = ("policy.onnx", "policy.safetensors", "policy.json")
VECTOR = spaces.Box(-np.inf, np.inf, (3,), np.float32)
ASYMMETRIC = spaces.Box(np.array([-1.0, 0.5, -30.0], np.float32), np.array([2.0, 0.75, 5.0], np.float32))


def by_key(function, *observations):
    """Apply a function to observations, or to those of each key."""
    if isinstance(observations[0], dict):
        return {key: function(*(each[key] for each in observations)) for key in observations[0]}
    return function(*observations)


class AnyEnv(gym.Env):
    """Random observations around a mean, whatever the spaces; goals too, for hindsight replay."""

    def __init__(self, observation_space, action_space, mean=0.0):
        self.observation_space, self.action_space, self.mean = observation_space, action_space, mean

    def _observe(self):
        return by_key(self._scale, self.observation_space.sample())

    def _scale(self, observation):
        return observation if observation.dtype == np.uint8 else (self.mean + 3.0 * observation).astype(observation.dtype)

    def compute_reward(self, achieved_goal, desired_goal, info):
        return np.zeros(len(np.atleast_2d(achieved_goal)), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self._observe(), {}

    def step(self, action):
        return self._observe(), 0.0, False, False, {}


def make_model(observation_space=VECTOR, action_space=ASYMMETRIC, normalize=None, policy="MlpPolicy", **kwargs):
    """A model whose actor and averaged actor differ, both with biases and actions well within the bounds."""
    # Far from zero, where float32 is coarse
    mean = 0.0 if normalize is None or normalize.keys() & {"norm_obs", "norm_obs_keys"} else 1000.0
    env = DummyVecEnv([lambda: AnyEnv(observation_space, action_space, mean)])
    if normalize is not None:
        env = VecNormalize(env, **normalize)
        env.reset()
        for _ in range(30):
            env.step(np.stack([action_space.sample()]))
    arguments = dict(buffer_size=10, seed=0, policy_kwargs=dict(net_arch=[16, 8]))
    model = CGP(policy, env, **(arguments | kwargs))
    for network in (model.actor, model.actor_target):
        for parameter in network.mu.parameters():
            nn.init.normal_(parameter, std=0.3)
    return model


def observations_of(model, n=7):
    (mean,) = model.get_env().get_attr("mean")
    env = AnyEnv(model.observation_space, model.action_space, mean)
    return by_key(lambda *each: np.stack(each), *(env._observe() for _ in range(n)))


def run_onnx(folder, observations):
    session = onnxruntime.InferenceSession(Path(folder) / "policy.onnx")
    inputs = observations if isinstance(observations, dict) else {"observation": observations}
    return session.run(["action"], inputs)[0]


IMAGE, IMAGE_FIRST = (spaces.Box(0, 255, shape, np.uint8) for shape in ((36, 40, 3), (3, 36, 40)))
DOUBLES = spaces.Box(-np.inf, np.inf, (2,), np.float64)
# In an order that is not the alphabet's, of the same shape, and with names that PyTorch gives to values of its graph
NAMES = OrderedDict((name, VECTOR) for name in ("view", "cat", "linear", "low", "mu_0", "input-0", "arm/joints:left"))
HER = dict(policy="MultiInputPolicy", replay_buffer_class=HerReplayBuffer)
GOALS = spaces.Dict(observation=spaces.Box(-np.inf, np.inf, (2, 2), np.float64), achieved_goal=DOUBLES, desired_goal=DOUBLES)


EXPORTS = {
    "ReLU": dict(),
    "Tanh, float64, averaged": dict(
        observation_space=spaces.Box(-5.0, np.inf, (2, 2), np.float64),
        action_space=spaces.Box(-3.0, 4.0, (2, 1), np.float64),
        inference="averaged_actor",
        policy_kwargs=dict(net_arch=[], activation_fn=nn.Tanh),
    ),
    "VecNormalize": dict(normalize=dict(clip_obs=0.7), policy_kwargs=dict(net_arch=[16], activation_fn=nn.SiLU)),
    "VecNormalize of rewards": dict(normalize=dict(norm_obs=False), policy_kwargs=dict(net_arch=[8], activation_fn=nn.ELU)),
    "images": dict(
        observation_space=spaces.Box(0, 255, (36, 40, 3), np.uint8),
        policy="CnnPolicy",
        policy_kwargs=dict(net_arch=[8], features_extractor_kwargs=dict(features_dim=16)),
    ),
    "Dict": dict(observation_space=spaces.Dict(NAMES), policy="MultiInputPolicy"),
    "Dict of goals in float64, VecNormalize": HER | dict(observation_space=GOALS, normalize=dict(clip_obs=0.7)),
    "Dict with images, one of two keys normalised, averaged": dict(
        observation_space=spaces.Dict(image=IMAGE_FIRST, speed=DOUBLES, wheels=spaces.Box(-9, 9, (4,), np.float32)),
        policy="MultiInputPolicy",
        normalize=dict(norm_obs_keys=["speed"]),
        inference="averaged_actor",
        policy_kwargs=dict(net_arch=[8], features_extractor_kwargs=dict(cnn_output_dim=6)),
    ),
    "Dict with images that are not divided by 255": dict(
        observation_space=spaces.Dict(image=IMAGE, vector=VECTOR),
        policy="MultiInputPolicy",
        policy_kwargs=dict(net_arch=[8], normalize_images=False),
    ),
}


@pytest.mark.parametrize("name", EXPORTS)
def test_exports_act_as_predict_does(name, tmp_path):
    model = make_model(**EXPORTS[name])
    model.export(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(FILES)
    policy = CGP.load_weights(tmp_path)
    assert (policy.observation_space, policy.action_space) == (model.observation_space, model.action_space)

    observations = observations_of(model)
    normalizer = model.get_vec_normalize_env()
    expected, _ = model.predict(observations if normalizer is None else normalizer.normalize_obs(observations))
    assert np.ptp(expected, axis=0).max() > 1e-2, "a constant policy would pass"
    for batch, wanted in ((observations, expected), (by_key(lambda each: each[:1], observations), expected[:1])):
        assert np.allclose(run_onnx(tmp_path, batch), wanted, rtol=1e-4, atol=1e-4)
        actions, state = policy.predict(batch, state=("kept",), episode_start=np.ones(len(wanted), bool), deterministic=False)
        assert np.allclose(actions, wanted, rtol=1e-5, atol=1e-5)
        assert (actions.dtype, actions.shape, state) == (wanted.dtype, wanted.shape, ("kept",))
    single, _ = policy.predict(by_key(lambda each: each[0], observations))
    assert single.shape == model.action_space.shape
    assert np.allclose(single, expected[0], rtol=1e-5, atol=1e-5)


@pytest.fixture
def no_onnx(monkeypatch):
    """ONNX takes a second to make: leave it out where it is not at issue."""
    monkeypatch.setattr("sb3_cgp.export.write._checked_onnx", lambda *args: b"another")


@pytest.mark.parametrize("name", exported.ACTIVATIONS)
@pytest.mark.usefixtures("no_onnx")
def test_every_activation_is_loaded_as_it_was(name, tmp_path):
    model = make_model(policy_kwargs=dict(net_arch=[8], activation_fn=getattr(nn, name)))
    model.export(tmp_path)
    observations = observations_of(model, 20)
    expected = model.predict(observations)[0]
    assert np.allclose(CGP.load_weights(tmp_path).predict(observations)[0], expected, rtol=1e-5, atol=1e-5)


@pytest.fixture(scope="module")
def exports(tmp_path_factory):
    """Two different exports; not to be written to."""
    folders, models = [], []
    for seed in (0, 1):
        folders.append(tmp_path_factory.mktemp("export"))
        models.append(make_model(seed=seed, normalize=dict() if seed == 0 else None))
        models[-1].export(folders[-1])
    return folders, models


@pytest.fixture(scope="module")
def dict_export(tmp_path_factory):
    """An export of goals and images, of which the goals are normalised; not to be written to."""
    folder = tmp_path_factory.mktemp("dict_export")
    shapes = dict(observation=spaces.Box(-np.inf, np.inf, (3,), np.float64), achieved_goal=DOUBLES, desired_goal=DOUBLES)
    space = spaces.Dict(shapes | dict(image=IMAGE_FIRST))
    kwargs = dict(net_arch=[8], features_extractor_kwargs=dict(cnn_output_dim=4))
    model = make_model(space, normalize=dict(norm_obs_keys=["observation", "achieved_goal"]), **HER, policy_kwargs=kwargs)
    model.export(folder)
    return folder, model


@pytest.fixture
def folder(exports, tmp_path):
    """A copy of an export, to be spoilt."""
    return Path(shutil.copytree(exports[0][0], tmp_path / "export"))


@pytest.mark.usefixtures("no_onnx")
def test_channels_last_images_are_taken_as_predict_takes_them(tmp_path):
    model = make_model(**EXPORTS["images"])
    model.export(tmp_path)
    images = np.random.default_rng(0).integers(0, 256, (4, 36, 40, 3), np.uint8)
    policy = CGP.load_weights(tmp_path)
    assert np.allclose(policy.predict(images)[0], model.predict(images)[0], rtol=1e-5, atol=1e-5)
    assert policy.predict(images[0])[0].shape == (3,)


def test_each_key_is_an_input_of_the_onnx_by_its_name(dict_export):
    folder, model = dict_export
    content = (folder / "policy.onnx").read_bytes()
    onnx.checker.check_model(onnx.load_from_string(content), full_check=True)
    found = {each.name: (each.type, each.shape[1:]) for each in onnxruntime.InferenceSession(content).get_inputs()}
    doubles = "tensor(double)"
    assert found == {
        "achieved_goal": (doubles, [2]),
        "desired_goal": (doubles, [2]),
        "image": ("tensor(uint8)", [3, 36, 40]),
        "observation": (doubles, [3]),
    }
    for other in (2, 3):
        batch = by_key(lambda each, size=other: each[:size], observations_of(model))
        assert run_onnx(folder, batch).shape == (other, 3)


@pytest.mark.usefixtures("no_onnx")
def test_channels_last_images_within_a_dict_are_taken_as_predict_takes_them(dict_export):
    folder, model = dict_export
    observations = observations_of(model, 4)
    policy = CGP.load_weights(folder)
    expected = policy.predict(observations)[0]
    observations["image"] = observations["image"].transpose(0, 2, 3, 1)
    assert np.array_equal(policy.predict(observations)[0], expected)


@pytest.mark.usefixtures("no_onnx")
def test_a_goal_policy_that_learnt_by_hindsight_is_evaluated_by_sb3_as_the_model_is(tmp_path):
    env = VecNormalize(DummyVecEnv([Reach]))
    arguments = HER | dict(learning_starts=10, batch_size=4, buffer_size=50, seed=0, policy_kwargs=dict(net_arch=[8]))
    model = CGP(arguments.pop("policy"), env, **arguments).learn(20)
    model.export(tmp_path)
    env.training = False
    returns = []
    for policy, tried in ((model, env), (CGP.load_weights(tmp_path), env.venv)):
        env.seed(3)
        returns.append(evaluate_policy(policy, tried, n_eval_episodes=3, return_episode_rewards=True, warn=False)[1])
    assert returns[0] == returns[1]


@pytest.mark.usefixtures("no_onnx")
def test_sb3_evaluates_an_exported_policy(tmp_path):
    model = CGP("MlpPolicy", "Pendulum-v1", buffer_size=10, seed=0)
    model.export(tmp_path)
    returns = []
    for policy in (model, CGP.load_weights(tmp_path)):
        model.get_env().seed(3)
        returns.append(evaluate_policy(policy, model.get_env(), n_eval_episodes=1)[0])
    assert returns[0] == pytest.approx(returns[1], rel=1e-4)


def test_wrong_observations_are_refused(exports):
    policy = CGP.load_weights(exports[0][0])
    with pytest.raises(ValueError, match="Unexpected observation shape"):
        policy.predict(np.zeros(4, np.float32))
    with pytest.raises(ValueError, match=r"`observation` is .*, but must be an array, as in Box"):
        policy.predict({"observation": np.zeros(3, np.float32)})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda found: found.pop("image"),
            r"`observation` is .*, but must be a dictionary of exactly the keys achieved_goal,",
        ),
        (lambda found: found.update(other=np.zeros(3)), "a dictionary of exactly the keys"),
        (lambda found: found.update(observation=np.zeros(4)), "Unexpected observation shape"),
        (lambda found: found.update(observation=np.zeros((5, 3))), "one observation for every key, or batches of one length"),
        (lambda found: found.update(observation=np.zeros(3)), "one observation for every key, or batches of one length"),
        (lambda found: found.update(observation=np.zeros((1, 3))), "one observation for every key, or batches of one length"),
    ],
)
def test_wrong_observations_of_a_dict_are_refused(dict_export, change, message):
    folder, model = dict_export
    policy, observations = CGP.load_weights(folder), observations_of(model, 4)
    policy.predict(observations)
    change(observations)
    with pytest.raises(ValueError, match=message):
        policy.predict(observations)
    with pytest.raises(ValueError, match="must be a dictionary of the keys achieved_goal"):
        policy.predict(np.zeros(3))


def test_onnx_says_nothing_of_the_machine_it_was_written_on(exports):
    content = (exports[0][0] / "policy.onnx").read_bytes()
    assert b".py" not in content
    assert str(Path.home()).encode() not in content
    onnx.checker.check_model(onnx.load_from_string(content), full_check=True)


def test_description_is_plain_json(exports):
    folders, (model, _) = exports
    description = json.loads((folders[0] / "policy.json").read_text(), parse_constant=pytest.fail)
    assert description["network"] == {
        "net_arch": [16, 8],
        "activation_fn": "ReLU",
        "features_extractor": "FlattenExtractor",
        "features_extractor_kwargs": {},
        "normalize_images": True,
    }
    assert description["observation_space"] == {"shape": [3], "dtype": "float32", "low": None, "high": None}
    assert description["action_space"]["low"] == [-1.0, 0.5, -30.0]
    assert (description["inference"], description["normalization"]["clip_obs"]) == ("actor", 10.0)
    tensors = load_file(folders[0] / "policy.safetensors")
    assert th.equal(tensors["mu.2.weight"], model.actor.mu[2].weight)
    assert np.array_equal(tensors["normalization.mean"].numpy(), model.get_vec_normalize_env().obs_rms.mean)


@pytest.mark.parametrize(
    "box",
    [
        spaces.Box(np.array([-np.inf, 0.1], np.float32), np.array([np.inf, 0.3], np.float32)),
        spaces.Box(0, 255, (2, 3, 4), np.uint8),
        spaces.Box(np.array([-(2**53) - 1]), np.array([2**53 + 1]), dtype=np.int64),
        spaces.Box(-np.inf, 1 / 3, (2, 1), np.float64),
    ],
    ids=str,
)
def test_boxes_come_back_as_they_were(box):
    text = json.dumps(describe_box(box), allow_nan=False)
    assert boxes.read_box(json.loads(text), "space", boxes.OBSERVATION_DTYPES) == box


# What cannot be exported


class OwnExtractor(FlattenExtractor):
    pass


class FlattenTwice(nn.ReLU):
    pass


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(inference="cem"), "`inference` is 'cem', but must be 'actor' or 'averaged_actor'"),
        (dict(policy_loss=None), "`inference` is 'cem', but must be 'actor' or 'averaged_actor'"),
        (dict(policy_training="offline"), r"`inference` is 'cem', but must be .*train_policy"),
        (
            dict(policy_kwargs=dict(features_extractor_class=OwnExtractor)),
            "`features_extractor_class` is .*OwnExtractor.*Flatten",
        ),
        (
            dict(policy_kwargs=dict(activation_fn=FlattenTwice)),
            "`activation_fn` is .*FlattenTwice.*, but must be one of ReLU, ",
        ),
        (dict(policy_kwargs=dict(activation_fn=nn.PReLU)), "`activation_fn` is .*PReLU.*, but must be one of ReLU, "),
        (dict(observation_space=spaces.Discrete(3)), r"`observation_space` is Discrete\(3\), but must be a Box"),
        (
            dict(observation_space=spaces.Dict(a=VECTOR, b=spaces.Discrete(2)), policy="MultiInputPolicy"),
            r"`observation_space\['b'\]` is Discrete\(2\), but must be a Box to be exported",
        ),
        (
            dict(observation_space=spaces.Dict(a=VECTOR, action=VECTOR), policy="MultiInputPolicy"),
            r"`observation_space` is 'action', but must be of keys that are .* and not 'action', which names the ONNX output",
        ),
        (
            dict(observation_space=spaces.Dict({"a b": VECTOR}), policy="MultiInputPolicy"),
            r"`observation_space` is 'a b', but must be of keys that are 1 to 64 of the characters",
        ),
        (
            dict(observation_space=spaces.Dict({f"k{i}": VECTOR for i in range(257)}), policy="MultiInputPolicy"),
            r"`observation_space` is Dict.*, but must be of at most 256 keys",
        ),
        (
            dict(
                observation_space=spaces.Box(0, 255, (36, 36, 3), np.uint8),
                policy="CnnPolicy",
                policy_kwargs=dict(features_extractor_kwargs=dict(features_dim=np.int64(4))),
            ),
            "`features_extractor_kwargs` is .*, but must be plain JSON",
        ),
    ],
)
def test_what_cannot_be_exported_is_named(change, message, tmp_path):
    env_spaces = {key: change[key] for key in ("observation_space",) if key in change}
    arguments = dict(buffer_size=10) | {key: value for key, value in change.items() if key != "observation_space"}
    policy = arguments.pop("policy", "MlpPolicy")
    env = AnyEnv(env_spaces.get("observation_space", VECTOR), ASYMMETRIC)
    model = CGP(policy, env, **arguments)
    with pytest.raises(ValueError, match=message):
        model.export(tmp_path / "export")
    assert not (tmp_path / "export").exists()


def test_a_policy_that_acts_otherwise_than_its_network_is_not_exported(tmp_path):
    model = make_model()
    model.actor.mu[0].register_forward_hook(lambda layer, inputs, output: output + 1.0)
    with pytest.raises(ValueError, match="acts as `predict` does, but differs by"):
        model.export(tmp_path)
    assert not list(tmp_path.iterdir())


def test_frames_stacked_after_normalisation_are_refused(tmp_path):
    env = VecFrameStack(VecNormalize(DummyVecEnv([lambda: AnyEnv(VECTOR, ASYMMETRIC)])), 2)
    with pytest.raises(ValueError, match="the one that VecNormalize normalises"):
        CGP("MlpPolicy", env, buffer_size=10).export(tmp_path)


@pytest.mark.usefixtures("no_onnx")
def test_statistics_that_are_not_there_are_missed(tmp_path):
    model = make_model(normalize=dict(), learning_starts=5, batch_size=2).learn(6)
    model.save(tmp_path / "model")
    loaded = CGP.load(tmp_path / "model")
    with pytest.raises(ValueError, match=r"`env` is None, but must be wrapped in VecNormalize .* `set_env`"):
        loaded.export(tmp_path / "export")
    loaded.set_env(model.get_env())
    loaded.export(tmp_path / "export")
    assert CGP.load_weights(tmp_path / "export").network.is_normalized


@pytest.mark.parametrize("missing", ["onnx", "onnxscript", "onnxruntime", "safetensors"])
def test_missing_extra_is_named(missing, tmp_path, monkeypatch):
    def import_module(name):
        if name.partition(".")[0] == missing:
            raise ModuleNotFoundError(f"No module named {missing!r}", name=missing)

    model = make_model()
    monkeypatch.setattr("importlib.import_module", import_module)
    remedy = re.escape(how_to_install("export"))
    assert '".[export]"' in how_to_install("export")
    with pytest.raises(ImportError, match=rf"needs {missing}, which is not installed. It is in the extra `export`: {remedy}"):
        model.export(tmp_path)
    if missing == "safetensors":
        with pytest.raises(ImportError, match=remedy):
            CGP.load_weights(tmp_path)


# Writing


@pytest.mark.parametrize("function", ["fsync", "replace"])
@pytest.mark.parametrize("call", range(3))
@pytest.mark.usefixtures("no_onnx")
def test_crash_while_writing_leaves_the_old_export_or_a_mix_that_is_recognised(exports, folder, monkeypatch, function, call):
    old = {name: (folder / name).read_bytes() for name in FILES}
    real, calls = getattr(os, function), iter(range(10))

    def crash(*args):
        if next(calls) == call:
            raise OSError("no space left on device")
        return real(*args)

    with monkeypatch.context() as patch:
        patch.setattr(os, function, crash)
        with pytest.raises(OSError, match="no space left"):
            exports[1][1].export(folder)
    assert sorted(path.name for path in folder.iterdir()) == sorted(FILES), "an unfinished file was left behind"
    new = {"policy.safetensors": (exports[0][1] / "policy.safetensors").read_bytes(), "policy.onnx": b"another"}
    if function == "fsync" or call == 0:
        assert {name: (folder / name).read_bytes() for name in FILES} == old
        CGP.load_weights(folder)
    else:
        assert all((folder / name).read_bytes() in (old[name], new.get(name)) for name in FILES)
        with pytest.raises(ValueError, match=r"policy\.safetensors was refused: its checksum .* of another export"):
            CGP.load_weights(folder)


@pytest.mark.usefixtures("no_onnx")
def test_files_are_on_the_disk_before_the_first_takes_its_place_and_the_description_comes_last(exports, folder, monkeypatch):
    done = []
    for name in ("fsync", "replace"):
        real = getattr(os, name)

        def noting(*args, name=name, real=real):
            done.append(name if name == "fsync" else Path(args[1]).name)
            return real(*args)

        monkeypatch.setattr(os, name, noting)
    exports[1][1].export(folder)
    assert done[:3] == ["fsync"] * 3
    assert sorted(done[3:5]) == ["policy.onnx", "policy.safetensors"]
    assert done[5:] == ["policy.json"] + ["fsync"] * (os.name == "posix")
    CGP.load_weights(folder)


# Files from strangers


class Payload:
    """Makes a file when it is unpickled."""

    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return open, (str(self.marker), "w")


def seal(folder):
    """Make the checksums right, as an attacker would."""
    path = folder / "policy.json"
    description = json.loads(path.read_text())
    for name in FILES[:2]:
        description["sha256"][name] = hashlib.sha256((folder / name).read_bytes()).hexdigest()
    path.write_text(json.dumps(description))


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("form", ["pickle", "torch"])
@pytest.mark.parametrize("sealed", [False, True])
def test_pickles_are_refused_and_not_run(folder, tmp_path, name, form, sealed):
    marker = tmp_path / "marker"
    path = folder / name
    if form == "pickle":
        path.write_bytes(pickle.dumps(Payload(marker)))
    else:
        th.save(Payload(marker), path)
    if sealed and name != "policy.json":
        seal(folder)
    if sealed and name == "policy.onnx":
        # Its checksum is right, and nothing else of it is looked at
        CGP.load_weights(folder)
    else:
        with pytest.raises(ValueError, match=f"{name} was refused"):
            CGP.load_weights(folder)
    assert not marker.exists()
    if form == "pickle":
        pickle.loads(pickle.dumps(Payload(marker))).close()
        assert marker.exists(), "the payload is harmless, and the test shows nothing"


def test_a_saved_model_holds_no_code(tmp_path):
    model = CGP("MlpPolicy", "Pendulum-v1", learning_rate="lin_1e-3", learning_starts=5, batch_size=2, buffer_size=10, seed=0)
    model.learn(10, callback=lambda *_: True).save(tmp_path / "model")
    with zipfile.ZipFile(tmp_path / "model.zip") as archive:
        data = json.loads(archive.read("data"))
    pickles = {name: value[":serialized:"] for name, value in data.items() if type(value) is dict and ":serialized:" in value}
    assert "lr_schedule" in pickles
    for name, value in pickles.items():
        # It is needed to load functions and classes that are pickled by their code, not by their name
        assert b"cloudpickle" not in base64.b64decode(value), name


def test_loading_calls_nothing_that_runs_code(exports, monkeypatch):
    def forbidden(*args, **kwargs):
        pytest.fail("code could have been run")

    for module, name in ((pickle, "load"), (pickle, "loads"), (pickle, "Unpickler"), (th, "load"), (builtins, "eval")):
        monkeypatch.setattr(module, name, forbidden)
    CGP.load_weights(exports[0][0])


def changed(*keys):
    """Set an entry of the description, given as a path of keys and then the value."""
    *path, last, value = keys

    def change(description):
        for key in path:
            description = description[key]
        description[last] = value

    return change


MALFORMED = {
    "another format": (changed("format", "zip"), "`format` is 'zip'"),
    "newer version": (changed("format_version", 3), "`format_version` is 3, but must be 1 or 2"),
    "version true": (changed("format_version", True), "`format_version` is True"),
    "no network": (lambda description: description.pop("network"), "`policy` is"),
    "extra key": (changed("code", "import os"), "`policy` is .*'code'"),
    "extra key within": (changed("network", "class", "os.system"), "`network` is .*'class'"),
    "network a list": (changed("network", []), r"`network` is \[\]"),
    "extractor of a Dict": (changed("network", "features_extractor", "CombinedExtractor"), "`features_extractor` is 'Comb"),
    "keys of a vector": (changed("normalization", "keys", ["observation"]), r"`normalization.keys` is \['observation'\]"),
    "unknown extractor": (changed("network", "features_extractor", "os.system"), "`features_extractor` is 'os.system'"),
    "unknown activation": (changed("network", "activation_fn", "PReLU"), "`activation_fn` is 'PReLU'"),
    "unhashable activation": (changed("network", "activation_fn", ["ReLU"]), r"`activation_fn` is \['ReLU'\]"),
    "other arguments": (changed("network", "features_extractor_kwargs", {"x": 1}), "`features_extractor_kwargs` is"),
    "normalize_images": (changed("network", "normalize_images", 1), "`normalize_images` is 1"),
    "CNN on a vector": (changed("network", "features_extractor", "NatureCNN"), "`network` is"),
    "wide": (changed("network", "net_arch", [10**15, 8]), r"mu\.\d\.weight is .* but must be .*1000000000000000"),
    "overflowing": (changed("network", "net_arch", [10**30]), "policy.json was refused"),
    "deep": (changed("network", "net_arch", [1] * 10**6), "at most 1000 layers"),
    "fractional": (changed("network", "net_arch", [16.0, 8]), r"`net_arch` is 16\.0"),
    "negative": (changed("network", "net_arch", [-16, 8]), "`net_arch` is -16"),
    "one layer more": (changed("network", "net_arch", [16, 8, 8]), r"missing are \['mu\.6\.bias"),
    "one layer less": (changed("network", "net_arch", [16]), r"too many \['mu\.4\.bias"),
    "other width": (changed("network", "net_arch", [16, 9]), "but must be torch.float32 of shape"),
    "huge observations": (changed("observation_space", "shape", [2**40]), "of at most"),
    "other observations": (changed("observation_space", "shape", [4]), r"but must be .* of shape \(4,\)"),
    "shape of text": (changed("observation_space", "shape", "3"), "`observation_space.shape` is '3'"),
    "dtype of objects": (changed("observation_space", "dtype", "object"), "`observation_space.dtype` is 'object'"),
    "bounds of text": (changed("observation_space", "low", "0"), "`observation_space.low` is '0'"),
    "too few bounds": (changed("action_space", "low", [0.0]), "`action_space.low` is"),
    "unbounded action": (changed("action_space", "low", None), "`action_space` is"),
    "upside down": (changed("action_space", "low", 100.0), "`action_space` is"),
    "beyond float32": (changed("action_space", "high", 10**400), "policy.json was refused"),
    "CEM": (changed("inference", "cem"), "`inference` is 'cem'"),
    "no normalisation": (changed("normalization", None), r"too many \['normalization.mean'"),
    "infinite clip": (changed("normalization", "clip_obs", 10**400), "policy.json was refused"),
    "negative epsilon": (changed("normalization", "epsilon", -1.0), "`epsilon` is -1.0"),
    "checksum": (changed("sha256", "policy.safetensors", "0"), "policy.safetensors was refused: its checksum"),
    "checksum of none": (changed("sha256", None), "`sha256` is None"),
}


def of_box(index, *change):
    """Set an entry of the description of one of a Dict's boxes."""
    return changed("observation_space", "boxes", index, *change)


def more_boxes(number, **entry):
    """Add boxes to the description of a Dict."""

    def change(description):
        boxes = description["observation_space"]["boxes"]
        boxes.extend({**boxes[0], "key": f"k{index}", **entry} for index in range(number))

    return change


MALFORMED_DICT = {
    "no boxes": (changed("observation_space", "boxes", []), "`observation_space.boxes` is \\[\\]"),
    "boxes of text": (changed("observation_space", "boxes", "abc"), "`observation_space.boxes` is 'abc'"),
    "a box of text": (of_box(0, "abc"), "`observation_space.boxes` is 'abc'"),
    "other entries": (changed("observation_space", "spaces", 1), "`observation_space` is .*'spaces'"),
    "other entries of a box": (of_box(0, "class", "os.system"), "`observation_space.boxes` is .*'class'"),
    "no key": (lambda description: description["observation_space"]["boxes"][0].pop("key"), "`observation_space.boxes` is"),
    "key of a number": (of_box(0, "key", 1), "`observation_space.boxes.key` is 1, but must be 1 to 64 of the characters"),
    "unhashable key": (of_box(0, "key", ["a"]), r"`observation_space.boxes.key` is \['a'\]"),
    "empty key": (of_box(0, "key", ""), "`observation_space.boxes.key` is ''"),
    "long key": (of_box(0, "key", "a" * 65), "`observation_space.boxes.key` is 'aaa"),
    "path": (of_box(0, "key", "../policy"), "`observation_space.boxes.key` is '../policy'"),
    "control characters": (of_box(0, "key", "a\n"), r"`observation_space.boxes.key` is 'a\\n'"),
    "letters of another alphabet": (of_box(0, "key", "\u0430"), "`observation_space.boxes.key` is"),
    "the output's name": (of_box(0, "key", "action"), "`observation_space.boxes.key` is 'action'"),
    "key twice": (of_box(0, "key", "observation"), "`observation_space.boxes.key` is 'observation', but must be .* once"),
    "an attribute of PyTorch's": (of_box(0, "key", "forward"), "`network` is .*which does not fit the spaces: .*forward"),
    "another attribute": (of_box(0, "key", "__class__"), "`network` is .*which does not fit the spaces: .*__class__"),
    "another key": (of_box(3, "key", "other"), "`normalization.keys` is .*, but must be a list of some of"),
    "another image": (of_box(2, "key", "picture"), "missing are .*extractors.picture.cnn"),
    "many keys": (more_boxes(1_000), "`observation_space.boxes` is .*, but must be a list of 1 to 256"),
    "huge": (more_boxes(1, shape=[2**40]), "`observation_space.boxes.k0.shape` is .* of at most"),
    "huge in total": (more_boxes(5, shape=[2**22]), "`observation_space.boxes.k3.shape` is .* of at most"),
    "dtype of objects": (of_box(0, "dtype", "object"), "`observation_space.boxes.achieved_goal.dtype` is 'object'"),
    "a box more": (more_boxes(1), "mu.0.weight is .* but must be"),
    "extractor of vectors": (changed("network", "features_extractor", "FlattenExtractor"), "`features_extractor` is 'Flatten"),
    "extractor of images": (changed("network", "features_extractor", "NatureCNN"), "`features_extractor` is 'NatureCNN'"),
    "other arguments": (
        changed("network", "features_extractor_kwargs", {"features_dim": 4}),
        "`features_extractor_kwargs` is",
    ),
    "width": (changed("network", "features_extractor_kwargs", {"cnn_output_dim": 0}), "`cnn_output_dim` is 0"),
    "wide": (changed("network", "features_extractor_kwargs", {"cnn_output_dim": 10**12}), "but must be .*1000000000000"),
    "overflowing": (changed("network", "features_extractor_kwargs", {"cnn_output_dim": 10**30}), "policy.json was refused"),
    "no keys normalised": (changed("normalization", "keys", None), "`normalization.keys` is None"),
    "unknown key normalised": (changed("normalization", "keys", ["speed"]), r"`normalization.keys` is \['speed'\]"),
    "unhashable key normalised": (changed("normalization", "keys", [["a"]]), r"`normalization.keys` is \[\['a'\]\]"),
    "key normalised twice": (changed("normalization", "keys", ["observation"] * 2), "`normalization.keys` is .* each once"),
    "one key less": (changed("normalization", "keys", ["observation"]), r"too many \['normalization.mean.achieved_goal'"),
    "one key more": (
        changed("normalization", "keys", ["observation", "achieved_goal", "image"]),
        r"missing are \['normalization.mean.image'",
    ),
    "version without keys": (changed("format_version", 1), "`normalization` is .*'keys'"),
}


@pytest.mark.parametrize("name", MALFORMED)
def test_descriptions_that_say_what_is_not_allowed_are_refused(folder, name):
    expect_refusal(folder, *MALFORMED[name])


@pytest.mark.parametrize("name", MALFORMED_DICT)
def test_descriptions_of_a_dict_that_say_what_is_not_allowed_are_refused(dict_export, tmp_path, name):
    expect_refusal(Path(shutil.copytree(dict_export[0], tmp_path / "export")), *MALFORMED_DICT[name])


def expect_refusal(folder, change, message):
    """Change a description, and expect that it is refused with the message."""
    path = folder / "policy.json"
    description = json.loads(path.read_text())
    change(description)
    path.write_text(json.dumps(description))
    with pytest.raises(ValueError, match=rf"(?s)^(?=.*policy\.\w+ was refused).*{message}"):
        CGP.load_weights(folder)


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "null", "NaN", '{"format": Infinity}', "[" * 100_000, "9" * 5_000, "\xff", '{"a": "\\ud800"}']
)
def test_json_that_is_none_or_of_another_kind_is_refused(folder, text):
    (folder / "policy.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(ValueError, match=r"policy\.json was refused"):
        CGP.load_weights(folder)


@pytest.mark.parametrize("sealed", [False, True])
def test_truncated_tensors_are_refused(folder, sealed):
    path = folder / "policy.safetensors"
    whole = path.read_bytes()
    header = 8 + struct.unpack("<Q", whole[:8])[0]
    for length in (0, 7, 8, 100, header - 1, header, header + 1, len(whole) - 1):
        path.write_bytes(whole[:length])
        if sealed:
            seal(folder)
        with pytest.raises(ValueError, match=r"policy\.safetensors was refused"):
            CGP.load_weights(folder)


@pytest.mark.parametrize("sealed", [False, True])
def test_flipped_bits_are_refused_or_change_numbers_only(folder, sealed):
    path = folder / "policy.safetensors"
    whole = path.read_bytes()
    for position in range(0, len(whole), 41):
        path.write_bytes(whole[:position] + bytes([whole[position] ^ 0x41]) + whole[position + 1 :])
        if sealed:
            seal(folder)
            try:
                CGP.load_weights(folder)
            except ValueError as error:
                assert "was refused" in str(error)  # noqa: PT017
        else:
            with pytest.raises(ValueError, match=r"policy\.safetensors was refused: its checksum"):
                CGP.load_weights(folder)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda tensors: tensors.update(extra=th.zeros(1)), r"too many \['extra'\]"),
        (lambda tensors: tensors.pop("mu.0.bias"), r"missing are \['mu.0.bias'\]"),
        (lambda tensors: tensors.update({"mu.0.bias": tensors["mu.0.bias"].double()}), "mu.0.bias is torch.float64"),
        (lambda tensors: tensors.update({"mu.0.bias": tensors["mu.0.bias"][None]}), r"of shape \(1, 16\)"),
        (lambda tensors: tensors["mu.0.bias"].fill_(np.nan), "mu.0.bias holds NaN"),
        (lambda tensors: tensors["normalization.variance"].fill_(-1.0), "normalization.variance.*positive"),
    ],
)
def test_tensors_that_do_not_belong_to_the_network_are_refused(folder, change, message):
    path = folder / "policy.safetensors"
    tensors = {name: tensor.clone() for name, tensor in load_file(path).items()}
    change(tensors)
    save_file(tensors, path)
    seal(folder)
    with pytest.raises(ValueError, match=rf"(?s)was refused: .*{message}"):
        CGP.load_weights(folder)


def test_an_export_of_the_formats_first_version_is_read(tmp_path):
    """As sb3-cgp wrote it before observations had keys."""
    content = {
        "format": "sb3-cgp policy",
        "format_version": 1,
        "versions": {"sb3_cgp": "0.1.0", "torch": "2.13.0+cpu"},
        "observation_space": {"shape": [2], "dtype": "float32", "low": None, "high": None},
        "action_space": {"shape": [1], "dtype": "float32", "low": -2.0, "high": 2.0},
        "network": {
            "net_arch": [],
            "activation_fn": "ReLU",
            "features_extractor": "FlattenExtractor",
            "features_extractor_kwargs": {},
            "normalize_images": True,
        },
        "inference": "actor",
        "normalization": {"epsilon": 0.0, "clip_obs": 10.0},
    }
    statistics = {
        "normalization.mean": th.tensor([1.0, 2.0]).double(),
        "normalization.variance": th.tensor([4.0, 9.0]).double(),
    }
    save_file({"mu.0.weight": th.tensor([[0.5, -1.0]]), "mu.0.bias": th.tensor([0.25]), **statistics}, tmp_path / FILES[1])
    (tmp_path / "policy.onnx").write_bytes(b"")
    (tmp_path / "policy.json").write_text(json.dumps(content | {"sha256": {}}))
    seal(tmp_path)
    action, _ = CGP.load_weights(tmp_path).predict(np.array([3.0, -1.0], np.float32))
    # Normalised, the observation is (1, -1)
    assert action == pytest.approx(2.0 * np.tanh(0.5 + 1.0 + 0.25), rel=1e-5)


@pytest.mark.parametrize("name", FILES[:2])
def test_files_of_two_exports_are_recognised(exports, folder, name):
    shutil.copy(exports[0][1] / name, folder / name)
    with pytest.raises(ValueError, match=f"{name} was refused: its checksum is not the one in policy.json"):
        CGP.load_weights(folder)


def test_files_that_are_missing(folder):
    expected = CGP.load_weights(folder).predict(np.ones(3, np.float32))[0]
    (folder / "policy.onnx").unlink()
    assert np.array_equal(CGP.load_weights(folder).predict(np.ones(3, np.float32))[0], expected)
    for name in ("policy.safetensors", "policy.json"):
        (folder / name).unlink()
        with pytest.raises(FileNotFoundError, match=name):
            CGP.load_weights(folder)
