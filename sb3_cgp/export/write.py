"""Exporting a policy: as ONNX, to act elsewhere, and as safetensors and JSON, to be loaded without pickle."""

import errno
import hashlib
import json
from copy import deepcopy
from pathlib import Path
from typing import Any, Protocol, TypeAlias

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from stable_baselines3.td3.policies import Actor

from sb3_cgp.common.extras import import_from_extra
from sb3_cgp.common.files import replace_all
from sb3_cgp.common.rules import require
from sb3_cgp.common.spaces import sample_of
from sb3_cgp.common.vec_normalize import WITH_STATISTICS, has_new_statistics, normalises
from sb3_cgp.common.version import __version__
from sb3_cgp.export.boxes import (
    KEYS_ALLOWED,
    MOST_KEYS,
    OBSERVATION,
    ObservationSpace,
    boxes_of,
    describe_box,
    describe_observations,
    is_key,
)
from sb3_cgp.export.description import (
    ACTIVATIONS,
    DESCRIPTION_FILE,
    EXPORTABLE_INFERENCES,
    EXTRACTORS,
    FORMAT,
    FORMAT_VERSION,
    ONNX_FILE,
    TENSORS_FILE,
    make_actor,
)
from sb3_cgp.export.normalization import statistics_names
from sb3_cgp.export.onnx_file import make_onnx, named_inputs, run_onnx
from sb3_cgp.export.policy import ExportedPolicy
from sb3_cgp.export.read import PURPOSE, build

# Of files, which a user may name in place of the folder
SUFFIXES = (".onnx", ".safetensors", ".json", ".zip")

# Observations at which an export is compared with `predict`
CHECKED_OBSERVATIONS = 16

# A batch, or one for each key
Observations: TypeAlias = np.ndarray | dict[str, np.ndarray]


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

    def predict(self, observation: np.ndarray | dict[str, np.ndarray]) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Return actions, as SB3's models do."""


def export_policy(model: ExportableModel, folder: str | Path) -> None:
    """
    Write ``policy.onnx``, ``policy.safetensors`` and ``policy.json``, see :meth:`sb3_cgp.CGP.export`.

    :param model: the model
    :param folder: the folder for the files; it is created if it is missing
    :raises ValueError: if the policy cannot be exported, or the folder has the name of a file; it says what is allowed
    :raises FileExistsError: if the folder is a file
    :raises ImportError: if a package of the ``export`` extra is not installed
    """
    if Path(folder).is_file():
        raise FileExistsError(errno.EEXIST, "Is a file, and must be a folder or a new name", str(folder))
    allowed = "the name of a folder, in which policy.onnx is written, such as 'exported_policy'"
    require(Path(folder).is_dir() or Path(folder).suffix not in SUFFIXES, "folder", str(folder), allowed)
    # Before anything is computed
    names = ("safetensors.torch", "onnxruntime", "onnx", "onnxscript")
    safetensors_torch, *_ = (import_from_extra(name, "export", PURPOSE) for name in names)
    normalizer = _normalizer(model)
    description = _describe(model, normalizer)
    _check_layers(_acting_actor(model), description, model)
    tensors = _tensors(model, normalizer)
    policy = build(description, tensors)
    observations = _observations(policy.observation_space, normalizer)
    normalized = observations if normalizer is None else normalizer.normalize_obs(observations)
    expected, _ = model.predict(normalized)
    _check_same("policy", policy.predict(observations)[0], expected, policy.action_space)
    onnx_content = _checked_onnx(policy, observations, expected)
    contents = {TENSORS_FILE: safetensors_torch.save(tensors), ONNX_FILE: onnx_content}
    description["sha256"] = {name: hashlib.sha256(content).hexdigest() for name, content in contents.items()}
    contents[DESCRIPTION_FILE] = (json.dumps(description, indent=2, allow_nan=False) + "\n").encode()
    replace_all(Path(folder), contents)


def _normalizer(model: ExportableModel) -> VecNormalize | None:
    """Return the wrapper that normalises the observations, or None if they are not normalised."""
    normalizer = model.get_vec_normalize_env()
    require(
        normalises(normalizer) or not model._learnt_normalized,
        "env",
        model.env,
        "wrapped in VecNormalize with its statistics, as the environment was that the model learnt from: "
        f"{WITH_STATISTICS} or `set_env` before exporting",
    )
    if not normalises(normalizer):
        return None
    allowed = f"one with the statistics that were saved with the model, not new ones: {WITH_STATISTICS}"
    require(not has_new_statistics(normalizer) or not model._learnt_normalized, "env", model.env, allowed)
    space = normalizer.venv.observation_space
    require(
        space == model.observation_space,
        "observation_space",
        model.observation_space,
        f"the one that VecNormalize normalises, {space}, to be exported: neither images nor frames stacked after it",
    )
    return normalizer


def _check_space(space: spaces.Space) -> None:
    """Check that an observation space can be exported."""
    require(isinstance(space, spaces.Box | spaces.Dict), "observation_space", space, "a Box or a Dict to be exported")
    if isinstance(space, spaces.Dict):
        allowed = f"of at most {MOST_KEYS} keys to be exported"
        require(len(space.spaces) <= MOST_KEYS, "observation_space", space, allowed)
        for key, box in space.spaces.items():
            require(is_key(key), "observation_space", key, f"of keys that are {KEYS_ALLOWED}, to be exported")
            require(isinstance(box, spaces.Box), f"observation_space['{key}']", box, "a Box to be exported")


def _describe(model: ExportableModel, normalizer: VecNormalize | None) -> dict[str, Any]:
    """Return the description of the policy in plain JSON, without the checksums of the other files."""
    policy = model.policy
    require(
        policy.inference in EXPORTABLE_INFERENCES,
        "inference",
        policy.inference,
        "'actor' or 'averaged_actor' to be exported: there is no trained actor, or it does not act (see `train_policy`)",
    )
    _check_space(model.observation_space)
    actor = _acting_actor(model)
    require(type(actor) is Actor, "actor", type(actor), "SB3's own to be exported")
    for name, value, allowed in (
        ("activation_fn", actor.activation_fn, ACTIVATIONS),
        ("features_extractor_class", type(actor.features_extractor), EXTRACTORS),
    ):
        is_known = any(value is each for each in allowed.values())
        require(is_known, name, value, f"one of {', '.join(allowed)} to be exported")
    try:
        extractor_kwargs = json.loads(json.dumps(policy.features_extractor_kwargs, allow_nan=False))
    except (TypeError, ValueError) as error:
        message = f"The value of `features_extractor_kwargs` is {policy.features_extractor_kwargs!r}, but must be plain JSON"
        raise ValueError(f"{message} to be exported: {error}.") from error
    normalization = None
    if normalizer is not None:
        clip_obs = float(normalizer.clip_obs)
        normalization = {
            "epsilon": float(normalizer.epsilon),
            "clip_obs": clip_obs if np.isfinite(clip_obs) else None,
            "keys": None if normalizer.norm_obs_keys is None else list(normalizer.norm_obs_keys),
        }
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "versions": {"sb3_cgp": __version__, "torch": th.__version__},
        "observation_space": describe_observations(model.observation_space),  # type: ignore[arg-type]
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


def _check_layers(actor: Actor, description: dict[str, Any], model: ExportableModel) -> None:
    """Check that an actor has the layers that its description says, and no others."""
    described = make_actor(description["network"], model.observation_space, model.action_space)  # type: ignore[arg-type]
    found, expected = (list(network.state_dict()) for network in (actor, described))
    require(found == expected, "actor", actor.mu, f"of the layers that SB3's actor has to be exported, {described.mu}")


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
        by_name = statistics if isinstance(statistics, dict) else {OBSERVATION: statistics}
        for name, each in by_name.items():
            names = statistics_names(normalizer.venv.observation_space, name)  # type: ignore[arg-type]
            tensors |= zip(names, (th.tensor(value, dtype=th.float64) for value in (each.mean, each.var)), strict=True)
    return tensors


def _observations(space: ObservationSpace, normalizer: VecNormalize | None) -> Observations:
    """Return random observations around the normaliser's mean, so that not all are clipped; leave the space's generator."""
    space = deepcopy(space)
    space.seed(0)
    boxes = boxes_of(space)
    samples: Observations = {
        name: np.stack([sample_of(box) for _ in range(CHECKED_OBSERVATIONS)]) for name, box in boxes.items()
    }
    if not isinstance(space, spaces.Dict):
        samples = samples[OBSERVATION]
    if normalizer is not None:
        samples = normalizer.unnormalize_obs(samples)
    if isinstance(samples, dict):
        return {name: each.astype(boxes[name].dtype) for name, each in samples.items()}
    return samples.astype(boxes[OBSERVATION].dtype)


def _check_same(what: str, actions: np.ndarray, expected: np.ndarray, space: spaces.Box) -> None:
    """Refuse an export whose actions differ from those of ``predict``, as those of a policy with a forward hook do."""
    difference = np.max(np.abs(actions - expected) / (space.high - space.low))
    require(
        bool(difference <= 1e-3),
        "policy",
        what,
        f"one that acts as `predict` does, but differs by {difference:.2g} of the range",
    )


def _checked_onnx(policy: ExportedPolicy, observations: Observations, expected: np.ndarray) -> bytes:
    """Return a policy as ONNX, after a comparison of its actions with the expected ones."""
    inputs = named_inputs(policy.observation_space, observations)
    content = make_onnx(policy.network, inputs)
    _check_same(ONNX_FILE, run_onnx(content, inputs), expected, policy.action_space)
    return content
