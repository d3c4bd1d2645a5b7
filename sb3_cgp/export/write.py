"""Exporting a policy: as ONNX, to act elsewhere, and as safetensors and JSON, to be loaded without pickle."""

import errno
import hashlib
import json
import logging
import warnings
from copy import deepcopy
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from stable_baselines3.td3.policies import Actor

from sb3_cgp.common.extras import import_from_extra
from sb3_cgp.common.files import replace_all
from sb3_cgp.common.rules import require
from sb3_cgp.common.version import __version__
from sb3_cgp.export.description import (
    ACTIVATIONS,
    DESCRIPTION_FILE,
    EXPORTABLE_INFERENCES,
    EXTRACTORS,
    FORMAT,
    FORMAT_VERSION,
    MEAN,
    ONNX_FILE,
    TENSORS_FILE,
    VARIANCE,
    describe_box,
)
from sb3_cgp.export.policy import ExportedPolicy
from sb3_cgp.export.read import PURPOSE, build

# The newest opset that PyTorch's exporter writes without a conversion; runtimes since 2023 read it
OPSET = 18
# Observations at which an export is compared with `predict`
CHECKED_OBSERVATIONS = 16


class ExportableModel(Protocol):
    """The attributes of a trained model that an export reads."""

    policy: Any
    actor: Actor
    actor_target: Actor
    env: VecEnv | None
    observation_space: spaces.Space
    action_space: spaces.Space
    # Whether the model learnt from observations that VecNormalize normalised; None before it has learnt
    _learnt_normalized: bool | None

    def get_vec_normalize_env(self) -> VecNormalize | None:
        """Return the VecNormalize wrapper of the model's environment, as SB3's models do."""

    def predict(self, observation: np.ndarray) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Return actions, as SB3's models do."""


def export_policy(model: ExportableModel, folder: str | Path) -> None:
    """
    Write ``policy.onnx``, ``policy.safetensors`` and ``policy.json``, see :meth:`sb3_cgp.CGP.export`.

    :param model: the model
    :param folder: the folder for the files; it is created if it is missing
    :raises ValueError: if the policy cannot be exported, naming the obstacle and what is allowed
    :raises FileExistsError: if the folder is a file
    :raises ImportError: if a package of the ``export`` extra is not installed
    """
    if Path(folder).is_file():
        raise FileExistsError(errno.EEXIST, "Is a file, and must be a folder or a new name", str(folder))
    names = ("safetensors.torch", "onnxruntime", "onnx", "onnxscript")
    safetensors_torch, onnxruntime, *_ = (import_from_extra(name, "export", PURPOSE) for name in names)
    normalizer = _normalizer(model)
    description = _describe(model, normalizer)
    tensors = _tensors(model, normalizer)
    policy = build(description, tensors)
    observations = _observations(policy.observation_space, normalizer)
    normalized = observations if normalizer is None else np.asarray(normalizer.normalize_obs(observations))
    expected, _ = model.predict(normalized)
    _check_same("policy", policy.predict(observations)[0], expected, policy.action_space)
    onnx_content = _checked_onnx(policy, observations, expected, onnxruntime)
    contents = {TENSORS_FILE: safetensors_torch.save(tensors), ONNX_FILE: onnx_content}
    description["sha256"] = {name: hashlib.sha256(content).hexdigest() for name, content in contents.items()}
    contents[DESCRIPTION_FILE] = (json.dumps(description, indent=2, allow_nan=False) + "\n").encode()
    replace_all(Path(folder), contents)


def _normalizer(model: ExportableModel) -> VecNormalize | None:
    """Return the wrapper that normalises the observations, or None if they are not normalised."""
    normalizer = model.get_vec_normalize_env()
    normalizes = normalizer is not None and normalizer.norm_obs
    require(
        normalizes or not model._learnt_normalized,
        "env",
        model.env,
        "wrapped in VecNormalize with its statistics, as the environment was that the model learnt from: "
        "use `set_env` before exporting",
    )
    if not normalizes:
        return None
    assert normalizer is not None
    space = normalizer.venv.observation_space
    require(
        space == model.observation_space,
        "observation_space",
        model.observation_space,
        f"the one that VecNormalize normalises, {space}, to be exported: neither images nor frames stacked after it",
    )
    return normalizer


def _describe(model: ExportableModel, normalizer: VecNormalize | None) -> dict[str, Any]:
    """Return the description of the policy in plain JSON, without the checksums of the other files."""
    policy = model.policy
    require(
        policy.inference in EXPORTABLE_INFERENCES,
        "inference",
        policy.inference,
        "'actor' or 'averaged_actor' to be exported: there is no trained actor, or it does not act (see `train_policy`)",
    )
    require(
        isinstance(model.observation_space, spaces.Box), "observation_space", model.observation_space, "a Box to be exported"
    )
    actor = _acting_actor(model)
    require(type(actor) is Actor, "actor", type(actor), "SB3's own to be exported")
    for name, value, allowed in (
        ("activation_fn", actor.activation_fn, ACTIVATIONS),
        ("features_extractor_class", type(actor.features_extractor), EXTRACTORS),
    ):
        require(allowed.get(value.__name__) is value, name, value, f"one of {', '.join(allowed)} to be exported")
    try:
        extractor_kwargs = json.loads(json.dumps(policy.features_extractor_kwargs, allow_nan=False))
    except (TypeError, ValueError) as error:
        message = f"The value of `features_extractor_kwargs` is {policy.features_extractor_kwargs!r}, but must be plain JSON"
        raise ValueError(f"{message} to be exported: {error}.") from error
    normalization = None
    if normalizer is not None:
        clip_obs = float(normalizer.clip_obs)
        normalization = {"epsilon": float(normalizer.epsilon), "clip_obs": clip_obs if np.isfinite(clip_obs) else None}
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "versions": {"sb3_cgp": __version__, "torch": th.__version__},
        "observation_space": describe_box(model.observation_space),  # type: ignore[arg-type]
        "action_space": describe_box(model.action_space),  # type: ignore[arg-type]
        "network": {
            "net_arch": [int(width) for width in actor.net_arch],
            "activation_fn": actor.activation_fn.__name__,
            "features_extractor": type(actor.features_extractor).__name__,
            "features_extractor_kwargs": extractor_kwargs,
            "normalize_images": actor.normalize_images,
        },
        "inference": policy.inference,
        "normalization": normalization,
    }


def _acting_actor(model: ExportableModel) -> Actor:
    """Return the network that ``predict`` uses."""
    return model.actor_target if model.policy.inference == "averaged_actor" else model.actor


def _tensors(model: ExportableModel, normalizer: VecNormalize | None) -> dict[str, th.Tensor]:
    """Return copies of the network's parameters and buffers, and the statistics of the observations, by name."""
    state = _acting_actor(model).state_dict()
    tensors = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in state.items()}
    if normalizer is not None:
        statistics = normalizer.obs_rms
        # Only the statistics of a Dict space are a dictionary
        assert not isinstance(statistics, dict)
        tensors[MEAN], tensors[VARIANCE] = (th.tensor(each, dtype=th.float64) for each in (statistics.mean, statistics.var))
    return tensors


def _observations(space: spaces.Box, normalizer: VecNormalize | None) -> np.ndarray:
    """Return random observations around the normaliser's mean, so that not all are clipped; leave the space's generator."""
    space = deepcopy(space)
    space.seed(0)
    samples = np.stack([space.sample() for _ in range(CHECKED_OBSERVATIONS)])
    return samples if normalizer is None else np.asarray(normalizer.unnormalize_obs(samples)).astype(space.dtype)


def _check_same(what: str, actions: np.ndarray, expected: np.ndarray, space: spaces.Box) -> None:
    """Refuse an export whose actions differ from those of ``predict``, as those of a policy with a forward hook do."""
    difference = np.max(np.abs(actions - expected) / (space.high - space.low))
    require(
        bool(difference <= 1e-3),
        "policy",
        what,
        f"one that acts as `predict` does, but differs by {difference:.2g} of the range",
    )


def _checked_onnx(policy: ExportedPolicy, observations: np.ndarray, expected: np.ndarray, onnxruntime: Any) -> bytes:
    """Return a policy as ONNX, for batches of any size, after a comparison of its actions with the expected ones."""
    registration = logging.getLogger("torch.onnx._internal.exporter._registration")
    level = registration.level
    # Without torchvision, the exporter warns of each of its operators; it also warns of deprecated functions of PyTorch
    registration.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            program = th.onnx.export(
                policy.network,
                (th.as_tensor(observations),),
                dynamo=True,
                input_names=["observation"],
                output_names=["action"],
                dynamic_shapes=({0: th.export.Dim("batch")},),
                opset_version=OPSET,
                verbose=False,
            )
    finally:
        registration.setLevel(level)
    assert program is not None
    proto = program.model_proto
    # PyTorch writes the source of each node, with paths of the user's machine
    proto.graph.ClearField("metadata_props")
    for part in (
        *proto.graph.node,
        *proto.graph.value_info,
        *proto.graph.initializer,
        *proto.graph.input,
        *proto.graph.output,
    ):
        part.ClearField("metadata_props")
        part.ClearField("doc_string")
    content = proto.SerializeToString()
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    actions = session.run(["action"], {"observation": observations})[0]
    _check_same(ONNX_FILE, actions, expected, policy.action_space)
    return content
