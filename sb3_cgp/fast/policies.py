"""CGP's policies with the fast scoring."""

from contextlib import nullcontext
from typing import Any

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_cgp.common.networks import evaluation_mode, set_mode
from sb3_cgp.common.rules import require_choice
from sb3_cgp.core import policies as core_policies
from sb3_cgp.core.cem import Score
from sb3_cgp.fast.cuda_graphs import Function
from sb3_cgp.fast.scoring import SCORING_DTYPES, q_score, scoring_dtype
from sb3_cgp.selectors import policies


class CGPPolicy(policies.CGPPolicy):
    """
    Policy class of CGP for vector observations: an action selector, an actor, critics, and their averages.

    The averaged actor φ' of Algorithm 2 is ``actor_target``, the target critics θ' are ``critic_target``.

    :param args: the arguments of :class:`sb3_cgp.core.policies.CGPPolicy`, and of SB3's ``TD3Policy``
    :param optimizer_class: The optimizer to use, ``th.optim.Adam`` by default
    :param optimizer_kwargs: Additional keyword arguments, excluding the learning rate, to pass to the optimizer.
        Adam is fused unless they say otherwise: the same step in fewer operations.
    :param cem_dtype: data type of all layers of the critic but the last one while the selector evaluates it: "float32",
        "bfloat16", or "auto", which is bfloat16 on processors that multiply it faster than float32
    :param kwargs: the same arguments by keyword
    :raises ValueError: if ``cem_dtype`` is not one of these
    """

    def __init__(
        self,
        *args: Any,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
        cem_dtype: str = "auto",
        **kwargs: Any,
    ):
        require_choice("cem_dtype", cem_dtype, SCORING_DTYPES)
        optimizer_kwargs = optimizer_kwargs or {}
        if optimizer_class is th.optim.Adam and not optimizer_kwargs.keys() & {"fused", "foreach", "differentiable"}:
            optimizer_kwargs = optimizer_kwargs | {"fused": True}
        super().__init__(*args, optimizer_class=optimizer_class, optimizer_kwargs=optimizer_kwargs, **kwargs)
        self.cem_dtype = cem_dtype
        # A CUDA graph of `select_actions` by the critic, in rollouts
        self.recorded_selection: Function | None = None

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return super()._get_constructor_parameters() | dict(cem_dtype=self.cem_dtype)

    def make_score(self, q_network: nn.Module, features: th.Tensor) -> Score:
        """
        Return the function that scores N actions for each of B states by a Q-network, see :mod:`sb3_cgp.fast.scoring`.

        :param q_network: maps features and actions side by side, (rows, F + A), to values, (rows, 1)
        :param features: the states' features, (B, F)
        :return: the scoring function, (B, N, A) -> (B, N)
        """
        return q_score(q_network, features, scoring_dtype(self.cem_dtype, features.device))

    def set_training_mode(self, mode: bool) -> None:
        """
        Put the actor and the critic in either training or evaluation mode, as TD3's policy does.

        :param mode: if true, set to training mode, else set to evaluation mode
        """
        # SB3 sets the mode at every prediction, which visits every module
        for network in (self.actor, self.critic):
            set_mode(network, mode)
        self.training = mode

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        if self.inference == "cem" and self.recorded_selection is not None:
            actions = self.recorded_selection(observation)[0]
            assert actions is not None
            return actions
        # Before acting, SB3 sets the modes of the actor and the critic alone
        with evaluation_mode(self.actor_target) if self.inference == "averaged_actor" else nullcontext():
            return super()._predict(observation, deterministic)


MlpPolicy = CGPPolicy


class CnnPolicy(CGPPolicy, core_policies.CnnPolicy):
    """Policy class of CGP for images: :class:`CGPPolicy` with SB3's ``NatureCNN`` as its features extractor."""


class MultiInputPolicy(CGPPolicy, core_policies.MultiInputPolicy):
    """Policy class of CGP for ``Dict`` observations: :class:`CGPPolicy` with SB3's ``CombinedExtractor``."""
