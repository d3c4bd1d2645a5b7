"""Exported policies: they act as ``predict`` does, and are written whole."""

import json
import os
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch as th
from environments import Reach
from exports import (
    DOUBLES,
    FILES,
    GOALS,
    HER,
    IMAGE,
    IMAGE_FIRST,
    NAMES,
    VECTOR,
    by_key,
    make_model,
    observations_of,
    run_onnx,
)
from gymnasium import spaces
from safetensors.torch import load_file
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from torch import nn

from sb3_cgp import CGP
from sb3_cgp.export import boxes
from sb3_cgp.export import description as exported
from sb3_cgp.export.boxes import describe_box

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


@pytest.mark.parametrize("is_dict", [False, True])
def test_a_space_of_all_float64_is_exported_though_it_cannot_be_sampled(is_dict, tmp_path):
    """Gymnasium's ``sample`` overflows."""
    widest = np.finfo(np.float64).max
    box = spaces.Box(np.array([-widest, -1.0]), np.array([widest, widest]), dtype=np.float64)
    with pytest.raises(OverflowError):
        box.sample()
    policy, space = ("MultiInputPolicy", spaces.Dict(x=box)) if is_dict else ("MlpPolicy", box)
    model = make_model(policy=policy, observation_space=space)
    model.export(tmp_path)
    observation = np.array([0.5, 0.2])
    observation = {"x": observation} if is_dict else observation
    found, expected = (each.predict(observation)[0] for each in (CGP.load_weights(tmp_path), model))
    assert np.allclose(found, expected, rtol=1e-5, atol=1e-5)


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


@pytest.mark.parametrize("name", exported.ACTIVATIONS)
@pytest.mark.usefixtures("no_onnx")
def test_every_activation_is_loaded_as_it_was(name, tmp_path):
    model = make_model(policy_kwargs=dict(net_arch=[8], activation_fn=getattr(nn, name)))
    model.export(tmp_path)
    observations = observations_of(model, 20)
    expected = model.predict(observations)[0]
    assert np.allclose(CGP.load_weights(tmp_path).predict(observations)[0], expected, rtol=1e-5, atol=1e-5)


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
