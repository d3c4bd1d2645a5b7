"""Exporting a policy: as ONNX to act anywhere, and as safetensors and JSON, from which it can be loaded without pickle."""

import hashlib
import json
import logging
import warnings
from copy import deepcopy
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecNormalize
from stable_baselines3.td3.policies import Actor

from sb3_cgp.common.files import replace_all
from sb3_cgp.common.rules import require
from sb3_cgp.export.read import (
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
    ExportedPolicy,
    build,
    describe_box,
    optional,
)

if TYPE_CHECKING:
    from sb3_cgp.core.cgp import CGP

# The newest that PyTorch's exporter writes without converting, and that runtimes since 2023 read
OPSET = 18
CHECKED_OBSERVATIONS = 16


def export_policy(model: "CGP", folder: str | Path) -> None:
    """
    Write ``policy.onnx``, ``policy.safetensors`` and ``policy.json``, see :meth:`sb3_cgp.CGP.export`.

    :param model: the model
    :param folder: where to write; it is made if it is missing
    :raises ValueError: if the policy cannot be exported, naming what is in the way and what is allowed
    :raises ImportError: if a package of the ``export`` extra is not installed
    """
    safetensors_torch = optional("safetensors.torch")
    for name in ("onnx", "onnxscript", "onnxruntime"):
        optional(name)
    normalizer = _normalizer(model)
    description = _describe(model, normalizer)
    tensors = _tensors(model, normalizer)
    policy = build(description, tensors)
    observations = _observations(policy.observation_space, normalizer)
    expected, _ = model.predict(observations if normalizer is None else normalizer.normalize_obs(observations))
    _check_same("policy", policy.predict(observations)[0], expected, policy.action_space)
    contents = {TENSORS_FILE: safetensors_torch.save(tensors), ONNX_FILE: _checked_onnx(policy, observations, expected)}
    description["sha256"] = {name: hashlib.sha256(content).hexdigest() for name, content in contents.items()}
    contents[DESCRIPTION_FILE] = (json.dumps(description, indent=2, allow_nan=False) + "\n").encode()
    replace_all(Path(folder), contents)


def _normalizer(model: "CGP") -> VecNormalize | None:
    """Find what normalises the observations, if anything does."""
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


def _describe(model: "CGP", normalizer: VecNormalize | None) -> dict[str, Any]:
    """Say what the policy is, as plain JSON; the files' checksums are missing yet."""
    # The package is not whole while this module is imported
    from sb3_cgp import __version__

    policy = model.policy
    require(
        policy.inference in EXPORTABLE_INFERENCES,
        "inference",
        policy.inference,
        "'actor' or 'averaged_actor' to be exported: there is no trained actor, or it is not asked (see `train_policy`)",
    )
    require(
        isinstance(model.observation_space, spaces.Box), "observation_space", model.observation_space, "a Box to be exported"
    )
    actor = _asked_actor(model)
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


def _asked_actor(model: "CGP") -> Actor:
    """Find the network that ``predict`` asks."""
    return model.actor_target if model.policy.inference == "averaged_actor" else model.actor


def _tensors(model: "CGP", normalizer: VecNormalize | None) -> dict[str, th.Tensor]:
    """Copy the parameters and buffers of the network, and the statistics of the observations."""
    state = _asked_actor(model).state_dict()
    tensors = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in state.items()}
    if normalizer is not None:
        statistics = normalizer.obs_rms
        # Only a Dict's would be by key
        assert not isinstance(statistics, dict)
        tensors[MEAN], tensors[VARIANCE] = (th.tensor(each, dtype=th.float64) for each in (statistics.mean, statistics.var))
    return tensors


def _observations(space: spaces.Box, normalizer: VecNormalize | None) -> np.ndarray:
    """Draw observations that do not all end at a bound, without a touch on the space's own random numbers."""
    space = deepcopy(space)
    space.seed(0)
    samples = np.stack([space.sample() for _ in range(CHECKED_OBSERVATIONS)])
    return samples if normalizer is None else np.asarray(normalizer.unnormalize_obs(samples)).astype(space.dtype)


def _check_same(what: str, actions: np.ndarray, expected: np.ndarray, space: spaces.Box) -> None:
    """Refuse an export that acts otherwise than ``predict``, as where a policy was overridden or hooked."""
    difference = np.max(np.abs(actions - expected) / (space.high - space.low))
    require(
        bool(difference <= 1e-3),
        "policy",
        what,
        f"one that acts as `predict` does, but differs by {difference:.2g} of the range",
    )


def _checked_onnx(policy: ExportedPolicy, observations: np.ndarray, expected: np.ndarray) -> bytes:
    """Write a policy as ONNX, for batches of any size, and see that it acts as it should."""
    registration = logging.getLogger("torch.onnx._internal.exporter._registration")
    level = registration.level
    # It warns of every operator of torchvision's where that is not installed, and of PyTorch's own deprecations
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
    # PyTorch notes where in the source each node comes from, with this machine's paths
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
    session = optional("onnxruntime").InferenceSession(content, providers=["CPUExecutionProvider"])
    actions = session.run(["action"], {"observation": observations})[0]
    _check_same(ONNX_FILE, actions, expected, policy.action_space)
    return content
