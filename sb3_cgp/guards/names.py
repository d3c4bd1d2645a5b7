"""Keyword arguments that a method or a policy does not take: errors with the nearest name, or the place of the argument."""

import functools
import inspect
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import ParamSpec, TypeVar

from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.td3.policies import TD3Policy

from sb3_cgp.common.rules import unknown_argument
from sb3_cgp.common.sb3_arguments import constructor_argument_names

P = ParamSpec("P")
T = TypeVar("T")

# The arguments of a policy that the algorithm gives
GIVEN_BY_ALGORITHM = {"self", "observation_space", "action_space", "lr_schedule"}

# Arguments of SAC and TQC, and of their policies, without a counterpart in an algorithm of TD3's kind
WITHOUT_COUNTERPART = {
    **dict.fromkeys(("ent_coef", "target_entropy"), "Leave it out: there is no entropy term."),
    **dict.fromkeys(
        ("use_sde", "sde_sample_freq", "use_sde_at_warmup", "log_std_init", "use_expln", "clip_mean"),
        "Leave it out: the actor has no standard deviation. CEM's samples explore; `action_noise` adds noise.",
    ),
    **dict.fromkeys(("n_quantiles", "top_quantiles_to_drop_per_net"), "Leave it out: the critics have no quantiles."),
}
IN_POLICY_KWARGS = dict.fromkeys(
    constructor_argument_names(TD3Policy) - GIVEN_BY_ALGORITHM | {"selector"},
    "It is an argument of the policy: give it in the constructor's `policy_kwargs`.",
)


def suggests_names(method: Callable[P, T]) -> Callable[P, T]:
    """
    Decorate a method so that the error for an unknown keyword argument has its value and a remedy.

    :param method: the method, without ``**kwargs``
    :return: the method, of the same signature
    """
    known = set(inspect.signature(method).parameters) - {"self", "_init_setup_model"}

    @functools.wraps(method)
    def checked(*args: P.args, **kwargs: P.kwargs) -> T:
        for name in kwargs.keys() - known - {"_init_setup_model"}:
            called = method.__qualname__.removesuffix(".__init__")
            raise unknown_argument(called, name, kwargs[name], known, WITHOUT_COUNTERPART | IN_POLICY_KWARGS)
        return method(*args, **kwargs)

    return checked


@contextmanager
def naming_policy_argument(model: OffPolicyAlgorithm) -> Iterator[None]:
    """
    Replace the error for an unknown argument among ``policy_kwargs`` by one with its value and a remedy.

    The error is not raised beforehand, as a policy of the user's own may take arguments that its signature does not name.

    :param model: the model whose policy is made within the context
    :raises TypeError: in place of Python's
    """
    try:
        yield
    except TypeError as error:
        found = re.search(r"__init__\(\) got an unexpected keyword argument '(\w+)'", str(error))
        if found is None or found[1] not in model.policy_kwargs:
            raise
        name, policy, algorithm = found[1], model.policy_class, type(model)
        outside = constructor_argument_names(algorithm)
        known = constructor_argument_names(policy) - GIVEN_BY_ALGORITHM - outside
        remedies = WITHOUT_COUNTERPART | dict.fromkeys(outside, f"Give it to `{algorithm.__name__}`, outside `policy_kwargs`.")
        raise unknown_argument(policy.__name__, name, model.policy_kwargs[name], known, remedies) from error
