"""Trainings that could not change a parameter: gradients that are off, and an actor that is frozen."""

import torch as th
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_cgp.common.rules import require


def check_gradients(model: OffPolicyAlgorithm) -> None:
    """
    Refuse to train where PyTorch's gradients are off, or networks that were made where they can never be switched on.

    :param model: the model
    :raises ValueError: naming what is off, and the remedy
    """
    allowed = "True to train: call it outside of `torch.no_grad()`, `torch.inference_mode()` and `set_grad_enabled(False)`"
    require(th.is_grad_enabled(), "torch.is_grad_enabled()", False, allowed)
    is_fixed = any(parameter.is_inference() for parameter in model.policy.parameters())
    allowed = "False to train: make or load the model outside of `torch.inference_mode()`"
    require(not is_fixed, "policy.is_inference()", True, allowed)


def check_actor_learns(actor: th.nn.Module) -> None:
    """
    Refuse to train an actor alone all of whose parameters are frozen.

    :param actor: the actor
    :raises ValueError: naming the remedy
    """
    allowed = (
        "True for some of its parameters where the policy is trained offline: call `model.actor.requires_grad_(True)`, or "
        "train critics alone by `policy_loss=None`"
    )
    require(any(each.requires_grad for each in actor.parameters()), "actor.requires_grad", False, allowed)
