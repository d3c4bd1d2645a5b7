"""What SB3's zip does not hold of a training: which parameters are frozen, and optimizers and schedules set on a model."""

from collections.abc import Collection
from typing import Any

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.save_util import recursive_getattr

from sb3_cgp.common.random_state import preserved_random_state
from sb3_cgp.resumption.model import SCHEDULES, ResumableModel


def frozen_parameters(policy: BasePolicy) -> list[str]:
    """
    Return the names of the parameters that are not trained.

    :param policy: the policy
    :return: the names of those without gradients
    """
    return [name for name, parameter in policy.named_parameters() if not parameter.requires_grad]


def freeze_parameters(policy: BasePolicy, names: Collection[str]) -> None:
    """
    Freeze parameters, and no others.

    :param policy: the policy
    :param names: what :func:`frozen_parameters` returned
    """
    for name, parameter in policy.named_parameters():
        parameter.requires_grad_(name not in names)


def lost_schedule(model: ResumableModel) -> str | None:
    """
    Say which schedule was set on a model, as SB3's ``load`` makes it anew of the arguments.

    :param model: the model
    :return: a sentence with the remedy; None if no schedule is lost
    """
    for name, arguments in SCHEDULES.items():
        if vars(model).get(name) is not model._made_schedules.get(name):
            return (
                f"`model.{name}` was set on the model, but a model that is loaded or resumed makes it of {arguments}. Give "
                "these to the constructor; a learning rate that changes is a function of the progress remaining, from 1 to 0."
            )
    return None


def check_savable_training(model: ResumableModel) -> None:
    """
    Refuse what was set on a model and differs from what ``resume`` makes: schedules and optimizers.

    :param model: the model
    :raises ValueError: naming the schedule or the optimizer, and the remedy
    """
    lost = lost_schedule(model)
    if lost is not None:
        raise ValueError(lost)
    _check_optimizers(model)


def _check_optimizers(model: ResumableModel) -> None:
    """Refuse an optimizer that was set on a model and is another one than that which ``resume`` makes. Check each once."""
    names = [name for name in model._get_torch_save_params()[0] if name.endswith(".optimizer")]
    optimizers = {name: recursive_getattr(model, name) for name in names}
    if optimizers == model._training.checked_optimizers:
        return
    try:
        with preserved_random_state(model.device):
            # As SB3 makes it in `load`
            policy: Any = model.policy_class(
                model.observation_space, model.action_space, lambda progress: 1.0, **model.policy_kwargs
            )
    except Exception:
        # An algorithm of the user's own may make its policy in another way
        policy = None
    for name, optimizer in optimizers.items():
        made = recursive_getattr(policy, name.removeprefix("policy."), None)
        if made is not None and _unsaved(optimizer, model.policy, model.policy) != _unsaved(made, policy, model.policy):
            raise ValueError(
                f"`model.{name}` is {_in_words(optimizer)}, but the policy makes {_in_words(made)}, into which `resume` "
                "would load the saved state. Where the training is saved, choose optimizers by "
                "`policy_kwargs=dict(optimizer_class=..., optimizer_kwargs=dict(...))`, and exclude parameters by "
                "`requires_grad_(False)`."
            )
    model._note_training(checked_optimizers=optimizers)


def _unsaved(optimizer: th.optim.Optimizer, policy: BasePolicy, trained: BasePolicy) -> Any:
    """
    Return what no state sets: an optimizer's class, its implementation, and the names of its parameters by group.

    Parameters that are frozen in the ``trained`` policy, or replaced by others that are, count as equal.
    """
    frozen = frozen_parameters(trained)
    names = {id(parameter): name for name, parameter in policy.named_parameters() if name not in frozen}
    groups = [[names.get(id(parameter)) for parameter in group["params"]] for group in optimizer.param_groups]
    return type(optimizer), bool(optimizer.defaults.get("fused")), groups


def _in_words(optimizer: th.optim.Optimizer) -> str:
    implementation = "fused " if optimizer.defaults.get("fused") else ""
    n_parameters = sum(len(group["params"]) for group in optimizer.param_groups)
    return f"{implementation}{type(optimizer).__name__} of {n_parameters} parameters"
