"""The rules on the arguments of CGP."""

from typing import Any

from sb3_cgp.common.rules import require, require_choice, require_count, require_number
from sb3_cgp.common.sb3_arguments import check_learning_rate, check_off_policy_arguments
from sb3_cgp.common.spaces import check_action_space


def check_cem(iterations: Any, samples: Any, elites: Any, result: Any, prefix: str = "") -> None:
    """
    Check the arguments of the Cross-Entropy Method; ``prefix`` precedes their names in errors.

    :raises ValueError: naming the first argument that breaks a rule
    """
    require_count(f"{prefix}iterations", iterations)
    require_count(f"{prefix}samples", samples)
    require_count(f"{prefix}elites", elites)
    require(elites <= samples, f"{prefix}elites", elites, f"at most `{prefix}samples`, which is {samples}")
    require_choice(f"{prefix}result", result, ("best", "mean"))


def check_arguments(model: Any, policy_losses: tuple[str, ...]) -> None:
    """
    Check the arguments of CGP, as attributes of the model, and that they are compatible.

    :param model: the model, before its networks are built
    :param policy_losses: names of the policy losses
    :raises ValueError: naming the first argument that breaks a rule, its value and what is allowed
    """
    check_off_policy_arguments(model)
    check_action_space(model.action_space)
    check_cem(model.cem_iterations, model.cem_samples, model.cem_elites, model.cem_result, prefix="cem_")
    for name in ("policy_delay", "target_update_interval"):
        require_count(name, getattr(model, name))
    for name in ("target_policy_noise", "target_noise_clip"):
        require_number(name, getattr(model, name))
    if model.actor_learning_rate is not None:
        check_learning_rate("actor_learning_rate", model.actor_learning_rate)

    loss, training, inference = model.policy_loss, model.policy_training, model.inference
    require_choice("policy_loss", loss, (*policy_losses, None))
    require_choice("policy_training", training, ("online", "offline"))
    require_choice("inference", inference, ("actor", "averaged_actor", "cem", None))
    given = model.policy_kwargs.get("inference")
    require(given is None, "policy_kwargs['inference']", given, "given as `inference`, outside `policy_kwargs`")
    if loss is None:
        require(training == "online", "policy_training", training, "'online' without a `policy_loss`")
        require(inference in ("cem", None), "inference", inference, "'cem' where `policy_loss=None` trains no actor")
    is_shared = bool(model.policy_kwargs.get("share_features_extractor", False))
    trains_online = loss is not None and training == "online"
    allowed = "False unless the policy is trained online: a shared extractor learns from the policy's loss alone"
    require(trains_online or not is_shared, "share_features_extractor", is_shared, allowed)
