"""What is not exported, and what an exported policy refuses."""

import functools
import json
import re

import numpy as np
import pytest
from exports import ASYMMETRIC, VECTOR, AnyEnv, make_model, observations_of
from gymnasium import spaces
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize
from torch import nn

from sb3_cgp import CGP, MlpPolicy
from sb3_cgp.common.extras import how_to_install


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
        (
            dict(policy_kwargs=dict(activation_fn=functools.partial(nn.LeakyReLU, 0.1))),
            r"`activation_fn` is functools.partial.*LeakyReLU.*, but must be one of ReLU, ",
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


@pytest.mark.parametrize("name", ["policy.onnx", "policy.safetensors", "policy.zip"])
def test_a_file_in_place_of_the_folder_is_refused(name, tmp_path):
    with pytest.raises(
        ValueError, match=rf"(?s)`folder` is '.*{name}', but must be the name of a folder, in which policy.onnx"
    ):
        make_model().export(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


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
    new = VecNormalize(model.get_env().venv)
    for training in (True, False):
        new.training = training
        loaded.set_env(new)
        with pytest.raises(ValueError, match=r"statistics that were saved with the model, not new ones: `load\(path, env="):
            loaded.export(tmp_path / "export")
    # As `learn` advises for raw observations
    loaded.set_env(VecNormalize(model.get_env().venv, training=False, clip_obs=np.inf))
    loaded.export(tmp_path / "raw")
    loaded.set_env(model.get_env())
    loaded.export(tmp_path / "export")
    assert json.loads((tmp_path / "export" / "policy.json").read_text())["normalization"]


def test_an_actor_of_other_layers_is_refused_by_name(tmp_path):
    class Normalising(MlpPolicy):
        def make_actor(self, features_extractor=None):
            actor = super().make_actor(features_extractor)
            actor.mu.insert(1, nn.LayerNorm(actor.mu[0].out_features))
            return actor

    with pytest.raises(ValueError, match=r"(?s)`actor` is .*LayerNorm.*must be of the layers that SB3's actor has"):
        make_model(policy=Normalising).export(tmp_path)


@pytest.mark.usefixtures("no_onnx")
def test_keys_to_normalise_may_be_a_tuple(tmp_path):
    boxes = {key: spaces.Box(-1, 1, (2,)) for key in ("a", "z")}
    normalize = dict(norm_obs_keys=("z", "a"))
    model = make_model(spaces.Dict(boxes), policy="MultiInputPolicy", normalize=normalize)
    model.export(tmp_path)
    observations = observations_of(model)
    expected, _ = model.predict(model.get_vec_normalize_env().normalize_obs(observations))
    np.testing.assert_allclose(CGP.load_weights(tmp_path).predict(observations)[0], expected, atol=1e-5)


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
