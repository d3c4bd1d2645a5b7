"""What SB3's zip does not hold of a training: which parameters are frozen, and optimizers and schedules set on a model."""

import warnings
from collections.abc import Callable, Collection
from typing import Any

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.save_util import recursive_getattr
from stable_baselines3.common.utils import LinearSchedule

from sb3_cgp.common.random_state import preserved_random_state
from sb3_cgp.common.sb3_arguments import as_schedule
from sb3_cgp.resumption.model import ResumableModel

# What SB3's `_setup_model` makes of arguments, and how
SCHEDULES: dict[str, tuple[str, Callable[[Any], Callable[[float], float]]]] = {
    "lr_schedule": ("`learning_rate`", lambda model: as_schedule(model.learning_rate)),
    "exploration_schedule": (
        "`exploration_initial_eps`, `exploration_final_eps` and `exploration_fraction`",
        lambda model: LinearSchedule(model.exploration_initial_eps, model.exploration_final_eps, model.exploration_fraction),
    ),
}
# Where schedules are compared
REMAINING = (1.0, 0.75, 0.5, 0.25, 0.0)


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


def warn_of_lost_schedules(model: ResumableModel) -> None:
    """
    Warn of a schedule that was set on a model, as SB3's ``load`` makes it anew of the arguments.

    :param model: the model
    """
    for name, (arguments, make) in SCHEDULES.items():
        schedule = vars(model).get(name)
        if schedule is None:
            continue
        made = make(model)
        # The user's own function is not called without need: it may count its calls
        is_same = _function_of(schedule) is _function_of(made)
        if not is_same and any(schedule(remaining) != made(remaining) for remaining in REMAINING):
            warnings.warn(
                f"`model.{name}` and {arguments} disagree. The model trains by the former; once it is loaded or resumed, it "
                "trains by the latter: set both alike on the model. A learning rate may be a function of the progress "
                "remaining, from 1 to 0.",
                stacklevel=3,
            )


def _function_of(schedule: Callable[[float], float]) -> Callable[[float], float]:
    """Return the function of which SB3 has made a schedule, or the schedule itself."""
    return getattr(schedule, "value_schedule", schedule)


def check_optimizers(model: ResumableModel) -> None:
    """
    Refuse an optimizer that was set on a model and is another one than that which ``resume`` makes. Check each of them once.

    :param model: the model
    :raises ValueError: naming the optimizer, and the remedy
    """
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
