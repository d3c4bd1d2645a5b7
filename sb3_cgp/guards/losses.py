"""Losses that are NaN or infinite."""

import math

import torch as th
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm


class LossGuard(OffPolicyAlgorithm):
    """An algorithm that calls ``_check_loss`` before an optimizer step: it takes none down a loss that is NaN or infinite."""

    def _check_loss(self, name: str, loss: th.Tensor) -> None:
        """
        Refuse a loss that is NaN or infinite.

        :param name: the network's name, "critic" or "actor"
        :param loss: the loss, a scalar
        :raises ValueError: if the loss is NaN or infinite; the network stays as it was
        """
        value = loss.item()
        if not math.isfinite(value):
            raise ValueError(
                f"The {name} loss is {value} at gradient step {self._n_updates}, environment step {self.num_timesteps}. "
                f"The {name} is as before that step."
            )
