"""The normalisation of an exported policy's observations, as ``VecNormalize`` computes it."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from torch import nn

from sb3_cgp.common.rules import require, require_number
from sb3_cgp.export.boxes import ObservationSpace, boxes_of, take_fields

MEAN, VARIANCE = "normalization.mean", "normalization.variance"


class Normalizer(nn.Module):
    """
    The normalisation of one box of observations.

    :param mean: the mean of the observations, of their shape and in float64
    :param variance: the variance of the observations, likewise
    :param epsilon: the constant added to the variance
    :param clip_obs: the bound for clipping, infinite for none
    """

    mean: th.Tensor
    deviation: th.Tensor

    def __init__(self, mean: th.Tensor, variance: th.Tensor, epsilon: float, clip_obs: float):
        super().__init__()
        self.clip_obs = clip_obs
        self.register_buffer("mean", mean)
        self.register_buffer("deviation", (variance + epsilon).sqrt())

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """
        Return normalised observations.

        :param observations: a batch of observations
        :return: the same batch, normalised and clipped, in float32
        """
        # In float64, as VecNormalize computes
        deviations = (observations.double() - self.mean) / self.deviation
        return deviations.clamp(-self.clip_obs, self.clip_obs).float()


def statistics_names(space: ObservationSpace, name: str) -> tuple[str, str]:
    """
    Return the names of the tensors of a box's mean and variance.

    :param space: the observation space
    :param name: the name of the box's ONNX input
    :return: the two names
    """
    return (f"{MEAN}.{name}", f"{VARIANCE}.{name}") if isinstance(space, spaces.Dict) else (MEAN, VARIANCE)


def normalized_names(normalization: Any, space: ObservationSpace) -> list[str]:
    """
    Check the description of the normalisation.

    :param normalization: the description; None where no observations are normalised
    :param space: the observation space
    :return: the names of the ONNX inputs that are normalised
    :raises ValueError: naming an entry that is not allowed
    """
    if normalization is None:
        return []
    epsilon, clip_obs, keys = take_fields(normalization, "normalization", ("epsilon", "clip_obs", "keys"))
    require_number("epsilon", epsilon)
    if clip_obs is not None:
        require_number("clip_obs", clip_obs)
    names = list(boxes_of(space))
    if not isinstance(space, spaces.Dict):
        require(keys is None, "normalization.keys", keys, "null for observations without keys")
        return names
    are_keys = isinstance(keys, list) and all(isinstance(key, str) and key in names for key in keys)
    require(are_keys and len(set(keys)) == len(keys), "normalization.keys", keys, f"a list of some of {names}, each once")
    return list(keys)


def make_normalizers(
    normalization: Any, names: list[str], space: ObservationSpace, tensors: Mapping[str, th.Tensor]
) -> dict[str, Normalizer]:
    """
    Create the normalisation of each box that is normalised.

    :param normalization: the description, which :func:`normalized_names` has checked
    :param names: the names that it returned
    :param space: the observation space
    :param tensors: the statistics, by name
    :return: the normalisers by the names of the ONNX inputs
    :raises ValueError: if a variance is not positive
    """
    normalizers = {}
    for name in names:
        mean_name, variance_name = statistics_names(space, name)
        mean, variance = tensors[mean_name], tensors[variance_name]
        epsilon, clip_obs = normalization["epsilon"], normalization["clip_obs"]
        is_positive = bool((variance >= 0.0).all() and (variance + epsilon > 0.0).all())
        require(is_positive, variance_name, variance, "positive")
        normalizers[name] = Normalizer(mean, variance, epsilon, np.inf if clip_obs is None else clip_obs)
    return normalizers
