"""Whether ``VecNormalize`` normalises observations, and by what statistics."""

from typing import TypeGuard

import numpy as np
from stable_baselines3.common.vec_env import VecNormalize

# For errors where a model has not the statistics that it has learnt with
WITH_STATISTICS = "`load(path, env=VecNormalize.load(statistics, env))`"


def normalises(normalizer: VecNormalize | None) -> TypeGuard[VecNormalize]:
    """
    Return whether observations are normalised.

    :param normalizer: the wrapper, if an environment has one
    :return: whether there is one, and it normalises observations
    """
    return normalizer is not None and normalizer.norm_obs


def has_new_statistics(normalizer: VecNormalize) -> bool:
    """
    Return whether observations are changed by statistics that have counted none.

    :param normalizer: the wrapper
    :return: False also without a bound, as new statistics then leave observations as they are, which may be intended
    """
    return count_observations(normalizer) < 1 and bool(np.isfinite(normalizer.clip_obs))


def count_observations(normalizer: VecNormalize) -> float:
    """
    Return how many observations the statistics know.

    :param normalizer: the wrapper
    :return: the number, of the key with the fewest for ``Dict`` observations; SB3's initial number is below 1
    """
    statistics = normalizer.obs_rms
    return float(min(each.count for each in statistics.values()) if isinstance(statistics, dict) else statistics.count)
