"""
The description of an exported policy, ``policy.json``: its format, and the network and spaces that it describes.

A description is data from an unknown source. A class is one of a fixed list, by its name, and sizes are checked before memory
of that size is allocated.
"""

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import FlattenExtractor, NatureCNN
from stable_baselines3.td3.policies import Actor
from torch import nn

from sb3_cgp.common.rules import require, require_choice, require_count

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
# Larger sizes are refused, as they would exhaust the memory
LARGEST_SPACE = 2**24
MOST_LAYERS = 1_000


def check_description(description: Any) -> None:
    """
    Check the format of a description, and the entries that need no other file.

    :param description: the content of ``policy.json``
    :raises ValueError: if the format or its version is another, or an entry is missing, unknown or not allowed
    """
    keys = ("format", "format_version", "versions", "observation_space", "action_space", "network", "inference")
    kind, version, versions, *_, inference, _, sha256 = take_fields(description, "policy", (*keys, "normalization", "sha256"))
    require(kind == FORMAT, "format", kind, repr(FORMAT))
    is_known = type(version) is int and version == FORMAT_VERSION
    require(is_known, "format_version", version, f"{FORMAT_VERSION} for this version of sb3-cgp; a newer one may read it")
    for name, value, names in (
        ("versions", versions, ("sb3_cgp", "torch")),
        ("sha256", sha256, (ONNX_FILE, TENSORS_FILE)),
    ):
        texts = take_fields(value, name, names)
        require(all(isinstance(text, str) for text in texts), name, value, "an object of strings")
    require_choice("inference", inference, EXPORTABLE_INFERENCES)


def describe_box(space: spaces.Box) -> dict[str, Any]:
    """
    Describe a box in plain JSON.

    :param space: the box
    :return: the shape, the data type, and the lower and upper bounds: one number if all are equal, otherwise a list of all in
        C order; None for an infinite bound
    """
    bounds = {}
    for name, values in (("low", space.low), ("high", space.high)):
        numbers = [number if np.isfinite(number) else None for number in values.ravel().tolist()]
        bounds[name] = numbers[0] if len(set(numbers)) == 1 else numbers
    return {"shape": list(space.shape), "dtype": space.dtype.name, **bounds}


def take_fields(value: Any, name: str, keys: tuple[str, ...]) -> list[Any]:
    """
    Return the values of a JSON object that has exactly the given keys.

    :param value: the object
    :param name: its name in errors
    :param keys: its keys
    :return: the values in the order of the keys
    :raises ValueError: if the value is not an object, or has other keys
    """
    require(isinstance(value, dict) and set(value) == set(keys), name, value, f"an object of {', '.join(keys)}")
    return [value[key] for key in keys]


def read_box(value: Any, name: str, dtypes: tuple[str, ...]) -> spaces.Box:
    """
    Create the box that :func:`describe_box` described.

    :param value: the description
    :param name: its name in errors
    :param dtypes: the data types that are allowed
    :return: the box
    :raises ValueError: naming an entry that is not allowed
    """
    shape, dtype, low, high = take_fields(value, name, ("shape", "dtype", "low", "high"))
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
        # Not isinstance, because True is an int, too
        are_numbers = all(number is None or type(number) in (int, float) for number in numbers)
        require(are_numbers, f"{name}.{bound}", values, "a number or null, or a list of them")
        bounds.append(np.array([infinity if number is None else number for number in numbers], dtype).reshape(shape))
    require(bool(np.all(bounds[0] <= bounds[1])), name, value, "of low <= high")
    return spaces.Box(bounds[0], bounds[1], tuple(shape), np.dtype(dtype).type)


def make_actor(network: Any, observation_space: spaces.Box, action_space: spaces.Box) -> Actor:
    """
    Create the actor on PyTorch's meta device, without memory for its parameters.

    :param network: the description of the network
    :param observation_space: the environment's observation space
    :param action_space: the environment's action space
    :return: the actor
    :raises ValueError: naming an entry that is not allowed or does not fit the spaces
    """
    keys = ("net_arch", "activation_fn", "features_extractor", "features_extractor_kwargs", "normalize_images")
    net_arch, activation_fn, extractor, kwargs, normalize_images = take_fields(network, "network", keys)
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
    # The errors of PyTorch and SB3 for sizes that do not fit together
    except (AssertionError, RuntimeError) as error:
        raise ValueError(f"The value of `network` is {network!r}, which does not fit the spaces: {error}") from error
