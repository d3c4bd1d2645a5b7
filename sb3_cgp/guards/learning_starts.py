"""Trainings that end before the first gradient step."""

import math
import warnings
from typing import Any, TypeVar

from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit

SelfLearningStartsGuard = TypeVar("SelfLearningStartsGuard", bound="LearningStartsGuard")


class LearningStartsGuard(OffPolicyAlgorithm):
    """
    An algorithm that warns if ``learn`` does no gradient step, for ``learning_starts`` is too large.

    It warns when the training starts, or, where the length of the last episode decides, when the training has ended. It does
    not warn of ``gradient_steps=0``, which says so itself.
    """

    _has_trained: bool = False

    def learn(self: SelfLearningStartsGuard, *args: Any, **kwargs: Any) -> SelfLearningStartsGuard:
        """
        Learn, and warn if that takes no gradient step.

        :param args: the algorithm's own arguments
        :param kwargs: the algorithm's own arguments
        :return: the trained model
        """
        self._has_trained = False
        result = super().learn(*args, **kwargs)
        has_ended = self._num_timesteps_at_start < self._total_timesteps <= self.num_timesteps
        if self._trains_by_episode and has_ended and not self._has_trained:
            self._warn_of_no_gradient_step(self.num_timesteps)
        return result

    def train(self, *args: Any, **kwargs: Any) -> None:
        """
        Do gradient steps, see the algorithm's method.

        :param args: the algorithm's own arguments
        :param kwargs: the algorithm's own arguments
        """
        self._has_trained = True
        super().train(*args, **kwargs)

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, Any]:
        total_timesteps, callback = super()._setup_learn(*args, **kwargs)
        if not self._trains_by_episode and self.num_timesteps < total_timesteps:
            assert isinstance(self.train_freq, TrainFreq)
            steps_per_rollout = self.train_freq.frequency * self.n_envs
            n_rollouts = math.ceil((total_timesteps - self.num_timesteps) / steps_per_rollout)
            self._warn_of_no_gradient_step(self.num_timesteps + n_rollouts * steps_per_rollout)
        return total_timesteps, callback

    @property
    def _trains_by_episode(self) -> bool:
        return isinstance(self.train_freq, TrainFreq) and self.train_freq.unit is TrainFrequencyUnit.EPISODE

    def _warn_of_no_gradient_step(self, last_timestep: int) -> None:
        """Warn if the training ends at an environment step at which no gradient step has been due."""
        # SB3 trains after a rollout that ends beyond `learning_starts`
        if last_timestep > self.learning_starts or self.gradient_steps == 0:
            return
        warnings.warn(
            f"Nothing is learnt: the training ends at environment step {last_timestep}, and gradient steps begin after step "
            f"learning_starts={self.learning_starts}. Give more `total_timesteps`, or a smaller `learning_starts`.",
            stacklevel=2,
        )

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_has_trained"]
