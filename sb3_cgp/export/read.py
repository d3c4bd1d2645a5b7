"""
A policy that was exported, and how it is read: from safetensors and JSON, which hold data and no code.

Whatever is in these files, reading them runs nothing of theirs: what names a class names one of a fixed list, and sizes are
compared before anything is allocated by them.
"""

import hashlib
import importlib
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import maybe_transpose
from stable_baselines3.common.torch_layers import FlattenExtractor, NatureCNN
from stable_baselines3.common.utils import is_vectorized_observation
from stable_baselines3.td3.policies import Actor
from torch import nn

from sb3_cgp.common.rules import check_action_space, require, require_choice, require_count, require_number

FORMAT = "sb3-cgp policy"
FORMAT_VERSION = 1
ONNX_FILE, TENSORS_FILE, DESCRIPTION_FILE = "policy.onnx", "policy.safetensors", "policy.json"
MEAN, VARIANCE = "normalization.mean", "normalization.variance"

ACTIVATIONS: dict[str, type[nn.Module]] = {
    cls.__name__: cls
    for cls in (nn.ReLU, nn.Tanh, nn.ELU, nn.LeakyReLU, nn.GELU, nn.SiLU, nn.Mish, nn.SELU, nn.Sigmoid, nn.Softplus)
}
EXTRACTORS: dict[str, type[FlattenExtractor] | type[NatureCNN]] = {cls.__name__: cls for cls in (FlattenExtractor, NatureCNN)}
EXPORTABLE_INFERENCES = ("actor", "averaged_actor")
OBSERVATION_DTYPES = ("float32", "float64", "uint8", "int8", "int16", "int32", "int64")
ACTION_DTYPES = ("float32", "float64")
# Beyond these, a file is taken for an attempt to exhaust the memory
LARGEST_SPACE = 2**24
MOST_LAYERS = 1_000


def optional(name: str) -> Any:
    """
    Import a package of the ``export`` extra.

    :param name: the module's name
    :return: the module
    :raises ImportError: if it is not installed, saying how to install it
    """
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        raise ImportError(
            f"Exporting policies and loading them needs {error.name}, which is not installed: pip install sb3-cgp[export]"
        ) from error


class ExportedNetwork(nn.Module):
    """
    From observations to actions, both in the environment's units.

    :param actor: the network that ``predict`` asks
    :param action_space: the environment's action space
    :param normalization: mean and variance of the observations, of their shape and in float64, the constant added to the
        variance, and the bound to clip at (infinite for none); None if observations are taken as they are
    """

    low: th.Tensor
    high: th.Tensor
    mean: th.Tensor
    deviation: th.Tensor

    def __init__(
        self, actor: Actor, action_space: spaces.Box, normalization: tuple[th.Tensor, th.Tensor, float, float] | None
    ):
        super().__init__()
        self.actor = actor
        self.action_shape = action_space.shape
        self.register_buffer("low", th.as_tensor(action_space.low))
        self.register_buffer("high", th.as_tensor(action_space.high))
        self.is_normalized = normalization is not None
        if normalization is not None:
            mean, variance, epsilon, self.clip_obs = normalization
            self.register_buffer("mean", mean)
            self.register_buffer("deviation", (variance + epsilon).sqrt())

    def forward(self, observation: th.Tensor) -> th.Tensor:
        """
        Act.

        :param observation: a batch of B observations
        :return: the actions, (B, *action_space.shape), within the action space's bounds and in its data type
        """
        if self.is_normalized:
            # In float64, as VecNormalize
            deviations = (observation.double() - self.mean) / self.deviation
            observation = deviations.clamp(-self.clip_obs, self.clip_obs).float()
        scaled = self.actor(observation).reshape(-1, *self.action_shape)
        low, high = self.low, self.high
        actions = low + (0.5 * (scaled.to(low.dtype) + 1.0) * (high - low))
        # Rounding can take the sum a last digit beyond the bounds
        return th.minimum(th.maximum(actions, low), high)


class ExportedPolicy:
    """
    A policy that acts, on the CPU, and can do nothing else.

    :param network: from observations to actions
    :param observation_space: the environment's observation space, images channels first
    :param action_space: the environment's action space
    :param description: what ``policy.json`` says
    """

    def __init__(
        self,
        network: ExportedNetwork,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        description: Mapping[str, Any],
    ):
        self.network = network
        self.observation_space = observation_space
        self.action_space = action_space
        self.description = description

    def predict(
        self,
        observation: np.ndarray,
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        Get the policy's action, as SB3's ``predict`` does.

        :param observation: one observation, of the observation space's shape, or a batch of B of them; not normalised.
            Images may be channels last.
        :param state: returned as it is, as the policy remembers nothing
        :param episode_start: of no influence
        :param deterministic: of no influence, as the actor has no noise
        :return: the action, of the action space's shape, or B of them; and the state
        :raises ValueError: if the observation has another shape
        """
        observation = maybe_transpose(np.asarray(observation), self.observation_space)
        is_batch = is_vectorized_observation(observation, self.observation_space)
        batch = np.ascontiguousarray(observation.reshape(-1, *self.observation_space.shape))
        with th.no_grad():
            actions = self.network(th.as_tensor(batch)).numpy()
        return (actions if is_batch else actions[0]), state


def describe_box(space: spaces.Box) -> dict[str, Any]:
    """
    Write a box as plain JSON.

    :param space: the box
    :return: its shape, data type and bounds: one number where all are equal, otherwise all of them in C order;
        null for an infinite one
    """
    bounds = {}
    for name, values in (("low", space.low), ("high", space.high)):
        numbers = [number if np.isfinite(number) else None for number in values.ravel().tolist()]
        bounds[name] = numbers[0] if len(set(numbers)) == 1 else numbers
    return {"shape": list(space.shape), "dtype": space.dtype.name, **bounds}


def _fields(value: Any, name: str, keys: tuple[str, ...]) -> list[Any]:
    """Take a JSON object apart, which must have these keys and no others."""
    require(isinstance(value, dict) and set(value) == set(keys), name, value, f"an object of {', '.join(keys)}")
    return [value[key] for key in keys]


def _read_box(value: Any, name: str, dtypes: tuple[str, ...]) -> spaces.Box:
    """Make a box of what :func:`describe_box` wrote."""
    shape, dtype, low, high = _fields(value, name, ("shape", "dtype", "low", "high"))
    require(isinstance(shape, list), f"{name}.shape", shape, "a list")
    size = 1
    for length in shape:
        require_count(f"{name}.shape", length)
        size *= length
        require(size <= LARGEST_SPACE, f"{name}.shape", shape, f"of at most {LARGEST_SPACE} elements")
    require_choice(f"{name}.dtype", dtype, dtypes)
    bounds = []
    for bound, values, infinity in (("low", low, -np.inf), ("high", high, np.inf)):
        numbers = values if isinstance(values, list) else [values] * size
        require(len(numbers) == size, f"{name}.{bound}", values, f"a number or null, or {size} of them")
        # Not isinstance, as True is an int, too
        are_numbers = all(number is None or type(number) in (int, float) for number in numbers)
        require(are_numbers, f"{name}.{bound}", values, "a number or null, or a list of them")
        bounds.append(np.array([infinity if number is None else number for number in numbers], dtype).reshape(shape))
    require(bool(np.all(bounds[0] <= bounds[1])), name, value, "of low <= high")
    return spaces.Box(bounds[0], bounds[1], tuple(shape), np.dtype(dtype).type)


def _make_actor(network: Any, observation_space: spaces.Box, action_space: spaces.Box) -> Actor:
    """Make the actor without its values: nothing is allocated for it."""
    keys = ("net_arch", "activation_fn", "features_extractor", "features_extractor_kwargs", "normalize_images")
    net_arch, activation_fn, extractor, kwargs, normalize_images = _fields(network, "network", keys)
    require(isinstance(net_arch, list), "net_arch", net_arch, "a list")
    require(len(net_arch) <= MOST_LAYERS, "net_arch", net_arch, f"of at most {MOST_LAYERS} layers")
    for width in net_arch:
        require_count("net_arch", width)
    require_choice("activation_fn", activation_fn, ACTIVATIONS)
    require_choice("features_extractor", extractor, EXTRACTORS)
    require(isinstance(normalize_images, bool), "normalize_images", normalize_images, "true or false")
    allowed = {"features_dim", "normalized_image"} if EXTRACTORS[extractor] is NatureCNN else set()
    are_allowed = isinstance(kwargs, dict) and set(kwargs) <= allowed
    require(are_allowed, "features_extractor_kwargs", kwargs, f"an object of no other keys than {sorted(allowed)}")
    require_count("features_dim", kwargs.get("features_dim", 1))
    normalized_image = kwargs.get("normalized_image", False)
    require(isinstance(normalized_image, bool), "normalized_image", normalized_image, "true or false")
    try:
        with th.device("meta"):
            features_extractor = EXTRACTORS[extractor](observation_space, **kwargs)
            return Actor(
                observation_space,
                action_space,
                net_arch,
                features_extractor,
                features_extractor.features_dim,
                ACTIVATIONS[activation_fn],
                normalize_images,
            )
    # What PyTorch and SB3 raise for sizes that do not go together
    except (AssertionError, RuntimeError) as error:
        raise ValueError(f"The value of `network` is {network!r}, which does not go with the spaces: {error}") from error


def _check_tensors(tensors: Mapping[str, th.Tensor], expected: Mapping[str, th.Tensor]) -> None:
    """Check that tensors are those expected, by name, shape and data type, and finite."""
    missing, extra = sorted(expected.keys() - tensors.keys()), sorted(tensors.keys() - expected.keys())
    if missing or extra:
        raise ValueError(f"The tensors do not belong to this network: missing are {missing}, and too many {extra}.")
    # In the network's order: safetensors returns its tensors in another one each time
    for name, value in expected.items():
        tensor = tensors[name]
        found, wanted = (f"{each.dtype} of shape {tuple(each.shape)}" for each in (tensor, value))
        if found != wanted:
            raise ValueError(f"The tensor {name} is {found}, but must be {wanted}.")
        if not bool(th.isfinite(tensor).all()):
            raise ValueError(f"The tensor {name} holds NaN or infinite values.")


def check_description(description: Any) -> None:
    """
    Check the part of a description that says what it is.

    :param description: what ``policy.json`` says
    :raises ValueError: if it is of another format or version, or lacks an entry, or has one too many
    """
    keys = ("format", "format_version", "versions", "observation_space", "action_space", "network", "inference")
    kind, version, versions, *_, inference, _, sha256 = _fields(description, "policy", (*keys, "normalization", "sha256"))
    require(kind == FORMAT, "format", kind, repr(FORMAT))
    is_known = type(version) is int and version == FORMAT_VERSION
    require(is_known, "format_version", version, f"{FORMAT_VERSION}, unless a newer sb3-cgp wrote it, which can read it")
    for name, value, names in (
        ("versions", versions, ("sb3_cgp", "torch")),
        ("sha256", sha256, (ONNX_FILE, TENSORS_FILE)),
    ):
        texts = _fields(value, name, names)
        require(all(isinstance(text, str) for text in texts), name, value, "an object of strings")
    require_choice("inference", inference, EXPORTABLE_INFERENCES)


def build(description: Mapping[str, Any], tensors: Mapping[str, th.Tensor]) -> ExportedPolicy:
    """
    Build a policy.

    :param description: what ``policy.json`` says
    :param tensors: the network's parameters and buffers, and the statistics of the observations, by name
    :return: the policy
    :raises ValueError: naming what is not allowed in them or does not go together
    """
    observation_space = _read_box(description["observation_space"], "observation_space", OBSERVATION_DTYPES)
    action_space = _read_box(description["action_space"], "action_space", ACTION_DTYPES)
    check_action_space(action_space)
    actor = _make_actor(description["network"], observation_space, action_space)
    expected: dict[str, th.Tensor] = {}
    normalization = None
    if description["normalization"] is not None:
        epsilon, clip_obs = _fields(description["normalization"], "normalization", ("epsilon", "clip_obs"))
        require_number("epsilon", epsilon)
        if clip_obs is not None:
            require_number("clip_obs", clip_obs)
        statistics = th.empty(observation_space.shape, dtype=th.float64, device="meta")
        expected = {MEAN: statistics, VARIANCE: statistics}
    _check_tensors(tensors, expected | actor.state_dict())
    if description["normalization"] is not None:
        mean, variance = tensors[MEAN], tensors[VARIANCE]
        require(bool((variance >= 0.0).all() and (variance + epsilon > 0.0).all()), VARIANCE, variance, "positive")
        normalization = (mean, variance, epsilon, np.inf if clip_obs is None else clip_obs)
    actor.load_state_dict({name: tensors[name] for name in actor.state_dict()}, assign=True)
    network = ExportedNetwork(actor, action_space, normalization).eval().requires_grad_(False)
    return ExportedPolicy(network, observation_space, action_space, description)


@contextmanager
def _refusing(path: Path, *errors: type[Exception]) -> Iterator[None]:
    """Make every error with what is in a file one that names it."""
    # Beside our own: JSON too deep, and numbers beyond a data type's range
    caught: tuple[type[Exception], ...] = (ValueError, RecursionError, OverflowError, *errors)
    try:
        yield
    except caught as error:
        raise ValueError(f"{path} was refused: {error}") from error


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is not JSON")


def load_weights(folder: str | Path) -> ExportedPolicy:
    """
    Build the policy that was exported to a folder. Neither unpickles nor runs anything of what is in the files.

    ``policy.onnx`` is not read, except to see that it is of the same export; it may be missing.

    :param folder: the folder
    :return: the policy
    :raises ValueError: if a file is damaged, of another export, or says what is not allowed; it names the file and why
    :raises FileNotFoundError: if ``policy.json`` or ``policy.safetensors`` is missing
    :raises ImportError: if safetensors is not installed
    """
    safetensors, safetensors_torch = optional("safetensors"), optional("safetensors.torch")
    paths = {name: Path(folder) / name for name in (DESCRIPTION_FILE, TENSORS_FILE, ONNX_FILE)}
    with _refusing(paths[DESCRIPTION_FILE]):
        description = json.loads(paths[DESCRIPTION_FILE].read_bytes(), parse_constant=_refuse_constant)
        check_description(description)
    content = paths[TENSORS_FILE].read_bytes()
    contents = {TENSORS_FILE: content}
    if paths[ONNX_FILE].exists():
        contents[ONNX_FILE] = paths[ONNX_FILE].read_bytes()
    for name, bytes_read in contents.items():
        with _refusing(paths[name]):
            if hashlib.sha256(bytes_read).hexdigest() != description["sha256"][name]:
                raise ValueError(f"its checksum is not the one in {DESCRIPTION_FILE}: it is damaged or of another export")
    with _refusing(paths[TENSORS_FILE], safetensors.SafetensorError, KeyError, RuntimeError, TypeError):
        tensors = safetensors_torch.load(content)
    # Which of the two is at fault cannot be said where they do not go together
    with _refusing(paths[DESCRIPTION_FILE], TypeError):
        return build(description, tensors)
