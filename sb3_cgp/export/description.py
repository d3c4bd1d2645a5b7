"""
The description of an exported policy, ``policy.json``: its format, and the network that it describes.

A description is data from an unknown source. A class is one of a fixed list, by its name, and sizes are checked before memory
of that size is allocated (those of the spaces in :mod:`sb3_cgp.export.boxes`).
"""

from typing import Any, TypeAlias

import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor, NatureCNN
from stable_baselines3.td3.policies import Actor
from torch import nn

from sb3_cgp.common.rules import require, require_choice, require_count
from sb3_cgp.export.boxes import ObservationSpace, take_fields

FORMAT = "sb3-cgp policy"
FORMAT_VERSION = 1
ONNX_FILE, TENSORS_FILE, DESCRIPTION_FILE = "policy.onnx", "policy.safetensors", "policy.json"

ACTIVATIONS: dict[str, type[nn.Module]] = {
    cls.__name__: cls
    for cls in (nn.ReLU, nn.Tanh, nn.ELU, nn.LeakyReLU, nn.GELU, nn.SiLU, nn.Mish, nn.SELU, nn.Sigmoid, nn.Softplus)
}
Extractor: TypeAlias = type[FlattenExtractor] | type[NatureCNN] | type[CombinedExtractor]
EXTRACTORS: dict[str, Extractor] = {cls.__name__: cls for cls in (FlattenExtractor, NatureCNN, CombinedExtractor)}
# The arguments of an extractor that an export may set
WIDTHS = {"NatureCNN": "features_dim", "CombinedExtractor": "cnn_output_dim"}
EXPORTABLE_INFERENCES = ("actor", "averaged_actor")
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


def make_actor(network: Any, observation_space: ObservationSpace, action_space: spaces.Box) -> Actor:
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
    require(isinstance(normalize_images, bool), "normalize_images", normalize_images, "true or false")
    _check_extractor(extractor, kwargs, observation_space)
    try:
        with th.device("meta"):
            # The check above has found the kind of space that this class takes
            features_extractor = EXTRACTORS[extractor](observation_space, **kwargs)  # type: ignore[arg-type]
            return Actor(
                observation_space,
                action_space,
                net_arch,
                features_extractor,
                features_extractor.features_dim,
                ACTIVATIONS[activation_fn],
                normalize_images,
            )
    # The errors of PyTorch and SB3 for sizes that do not fit together, and for keys that name an attribute of `ModuleDict`
    except (AssertionError, KeyError, RuntimeError) as error:
        raise ValueError(f"The value of `network` is {network!r}, which does not fit the spaces: {error}") from error


def _check_extractor(extractor: Any, kwargs: Any, observation_space: ObservationSpace) -> None:
    """Check the features extractor's name and arguments."""
    is_dict = isinstance(observation_space, spaces.Dict)
    fitting = [name for name, cls in EXTRACTORS.items() if (cls is CombinedExtractor) == is_dict]
    require_choice("features_extractor", extractor, fitting)
    width = WIDTHS.get(extractor)
    allowed = {"normalized_image"} | {width} if width is not None else set()
    are_allowed = isinstance(kwargs, dict) and set(kwargs) <= allowed
    require(are_allowed, "features_extractor_kwargs", kwargs, f"an object of no other keys than {sorted(allowed)}")
    if width is not None:
        require_count(width, kwargs.get(width, 1))
    normalized_image = kwargs.get("normalized_image", False)
    require(isinstance(normalized_image, bool), "normalized_image", normalized_image, "true or false")
