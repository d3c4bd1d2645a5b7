"""Exports from strangers: they are loaded from data that runs nothing, or refused."""

import base64
import builtins
import hashlib
import json
import pickle
import shutil
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch as th
from exports import FILES
from safetensors.torch import load_file, save_file

from sb3_cgp import CGP


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
    "newer version": (changed("format_version", 2), "`format_version` is 2, but must be 1 for"),
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
    "no keys": (lambda description: description["normalization"].pop("keys"), "`normalization` is .*clip_obs, keys"),
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


def test_an_export_that_is_written_by_hand_acts_as_computed_by_hand(tmp_path):
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
        "normalization": {"epsilon": 0.0, "clip_obs": 10.0, "keys": None},
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
