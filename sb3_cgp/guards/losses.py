"""Losses that are NaN or infinite, or those of a frozen actor."""

import math

import torch as th
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm


class LossGuard(OffPolicyAlgorithm):
    """
    An algorithm, with a method ``_descend``, that takes no optimizer step down a loss that is NaN or infinite.

    Nor does it down the loss of a frozen actor, which has no gradient.
    """

    def _descend(self, name: str, loss: th.Tensor) -> None:
        """
        Take an optimizer step down a loss.

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
        # Not where the user has frozen the actor, by `requires_grad_(False)`; TD3's loss of the actor has a gradient even so
        if loss.requires_grad or name != "actor":
            super()._descend(name, loss)  # type: ignore[misc]  # of the algorithm that this class is mixed into
