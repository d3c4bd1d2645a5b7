"""The statistics of observations that ``VecNormalize`` holds."""

from stable_baselines3.common.vec_env import VecNormalize

# For errors where a model has not the statistics that it has learnt with
WITH_STATISTICS = "`load(path, env=VecNormalize.load(statistics, env))`"


def count_observations(normalizer: VecNormalize) -> float:
    """
    Return how many observations the statistics know.

    :param normalizer: the wrapper
    :return: the number, of the key with the fewest for ``Dict`` observations; SB3's initial number is below 1
    """
    statistics = normalizer.obs_rms
    return float(min(each.count for each in statistics.values()) if isinstance(statistics, dict) else statistics.count)
