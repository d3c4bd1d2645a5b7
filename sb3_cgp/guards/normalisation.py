"""``VecNormalize`` that is missing, new, or inside of wrappers that change observations after it."""

import warnings
from typing import Any

import numpy as np
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize, VecTransposeImage, unwrap_vec_normalize

from sb3_cgp.common.spaces import by_key, have_same_layout
from sb3_cgp.common.vec_normalize import WITH_STATISTICS, count_observations, has_new_statistics, normalises


class NormalisationGuard(OffPolicyAlgorithm):
    """
    An algorithm that remembers whether its networks have learnt from normalised observations.

    A model that has, and meets observations that are not, is refused: its actions would be meaningless. In the opposite case
    the user has just added ``VecNormalize``, and is warned.
    """

    # None until the first gradient step
    _learnt_normalized: bool | None = None
    _has_checked_statistics: bool = False

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, Any]:
        self._check_normalisation()
        last_obs = self._last_obs
        result = super()._setup_learn(*args, **kwargs)
        self._has_checked_statistics = False
        if self._last_obs is not last_obs:
            # A reset has just updated the statistics: the observations were normalised by them
            _check_normalised(self._last_obs, self._last_original_obs, self._vec_normalize_env)
        return result

    def train(self, *args: Any, **kwargs: Any) -> None:
        """
        Do gradient steps, see the algorithm's method, and remember whether the observations are normalised.

        :param args: the algorithm's own arguments
        :param kwargs: the algorithm's own arguments
        """
        if not self._has_checked_statistics:
            # Not earlier, as a callback restores the statistics of a resumed training when its first rollout starts
            self._has_checked_statistics = True
            self._warn_of_new_statistics()
        self._learnt_normalized = normalises(self._vec_normalize_env)
        super().train(*args, **kwargs)

    def _check_normalisation(self) -> None:
        """
        Check that observations are normalised if the networks have learnt from normalised ones.

        :raises ValueError: if they are not
        """
        is_normalized = normalises(self._vec_normalize_env)
        if self._learnt_normalized and not is_normalized:
            raise ValueError(
                f"The value of `env` is {self.env!r}, but must normalise observations, as the model has learnt from "
                f"normalised ones: use {WITH_STATISTICS}, or `set_env`, with the statistics "
                "that were saved with the model. If raw observations are intended, use `VecNormalize(env, training=False, "
                "clip_obs=float('inf'))`, whose new statistics leave observations as they are."
            )
        if self._learnt_normalized is False and is_normalized:
            warnings.warn(
                "The model has learnt from observations that were not normalised, and `env` normalises them now "
                "(`VecNormalize` with `norm_obs=True`): the networks see other values than before. Use `norm_obs=False`, or "
                "train a new model.",
                stacklevel=2,
            )

    def _warn_of_new_statistics(self) -> None:
        """Warn if ``VecNormalize`` has counted this training's observations alone, unlike that with which the model learnt."""
        normalizer = self._vec_normalize_env
        if not self._learnt_normalized or not normalises(normalizer):
            return
        # The steps of this training, its reset, and SB3's initial count
        n_own = self.num_timesteps - self._num_timesteps_at_start + self.n_envs + 1e-3
        # Saved statistics have counted
        is_new = count_observations(normalizer) <= n_own if normalizer.training else has_new_statistics(normalizer)
        if is_new:
            warnings.warn(
                "The model has learnt from normalised observations, and the `VecNormalize` of `env` has new statistics: the "
                f"networks see other observations than before. Use {WITH_STATISTICS}, with "
                "the statistics that were saved with the model.",
                stacklevel=2,
            )

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_has_checked_statistics"]


def check_wrappers(env: VecEnv) -> None:
    """
    Refuse wrappers that change observations outside of ``VecNormalize``.

    The replay buffer stores observations as ``VecNormalize`` was given them, and normalises them when they are sampled.
    Changes that are made after it are lost.

    :param env: the environment
    :raises ValueError: naming the wrapper, and the order that is allowed
    """
    normalizer = unwrap_vec_normalize(env)
    while normalizer is not None and env is not normalizer:
        assert isinstance(env, VecEnvWrapper)
        transposes = isinstance(env, VecTransposeImage) and not env.skip
        if transposes or not have_same_layout(env.observation_space, env.venv.observation_space):
            name = type(env).__name__
            inside = normalizer.observation_space
            hint = (
                "SB3 adds it where it is missing and images have their channels last"
                if isinstance(env, VecTransposeImage)
                else "in rl_zoo3, use a wrapper of the single environment (`env_wrapper`) in place of `frame_stack`"
            )
            raise ValueError(
                f"The value of `env.observation_space` is {env.observation_space}, but must be the one that VecNormalize "
                f"normalises, {inside}: {name} must not lie outside of VecNormalize, as the replay buffer stores "
                f"observations without it. Wrap in the other order, `VecNormalize({name}(...))`; {hint}."
            )
        env = env.venv


def _check_normalised(observations: Any, original: Any, normalizer: VecNormalize | None) -> None:
    """Refuse first observations that a wrapper outside of ``VecNormalize`` has changed without changing their space."""
    if normalizer is None or original is None:
        return
    found, expected = by_key(observations), by_key(normalizer.normalize_obs(original))
    if not all(np.allclose(found[key], each, equal_nan=True) for key, each in expected.items()):
        raise ValueError(
            "The environment's observations are not those that VecNormalize returned: a wrapper outside of it changes them, "
            "which the replay buffer does not see. Put that wrapper inside of VecNormalize."
        )
