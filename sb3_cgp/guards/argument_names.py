"""Keyword arguments that a method or a policy does not take: errors with the nearest name, or the place of the argument."""

import functools
import inspect
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, ParamSpec, TypeVar

from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.td3.policies import TD3Policy

from sb3_cgp.common.rules import unknown_argument
from sb3_cgp.common.sb3_arguments import constructor_argument_names

P = ParamSpec("P")
T = TypeVar("T")

# The arguments of a policy that the algorithm gives
GIVEN_BY_ALGORITHM = {"self", "observation_space", "action_space", "lr_schedule"}
# As difflib measures it: less similar names have other meanings, such as `gradient_clip` and `gradient_steps`
SIMILAR = 0.75

# Remedies for arguments of other algorithms, and of other functions, that users give to a constructor by mistake
LEAVE_OUT = {
    **dict.fromkeys(("ent_coef", "target_entropy"), "Leave it out: there is no entropy term."),
    **dict.fromkeys(
        ("use_sde", "sde_sample_freq", "use_sde_at_warmup", "log_std_init", "use_expln", "clip_mean"),
        "Leave it out: the actor has no standard deviation.",
    ),
    **dict.fromkeys(("n_quantiles", "top_quantiles_to_drop_per_net"), "Leave it out: the critics have no quantiles."),
    **dict.fromkeys(("max_grad_norm", "gradient_clip"), "Leave it out: gradients are not clipped."),
}
ELSEWHERE = {
    **dict.fromkeys(
        constructor_argument_names(TD3Policy) - GIVEN_BY_ALGORITHM | {"selector"},
        "It is an argument of the policy: give it in `policy_kwargs`.",
    ),
    **dict.fromkeys(("total_timesteps", "callback", "log_interval", "progress_bar"), "Give it to `learn`."),
    **dict.fromkeys(("tb_log_name", "reset_num_timesteps"), "Give it to `learn`."),
    **dict.fromkeys(("n_timesteps", "timesteps"), "Give `total_timesteps` to `learn`."),
    **dict.fromkeys(("n_envs", "env_kwargs"), "Give it to SB3's `make_vec_env`, and the result as `env`."),
    **dict.fromkeys(("eval_env", "eval_freq"), "Give SB3's `EvalCallback` to `learn`, as `callback`."),
    **dict.fromkeys(("noise_type", "noise_std"), "Outside of rl_zoo3, give `action_noise=NormalActionNoise(mean, std)`."),
    **dict.fromkeys(("n_sampled_goal", "goal_selection_strategy", "copy_info_dict"), "Give it in `replay_buffer_kwargs`."),
    "lr": "Did you mean `learning_rate`?",
    "actor_lr": "Did you mean `actor_learning_rate`?",
    "policy_freq": "Did you mean `policy_delay`?",
    "target_noise": "Did you mean `target_policy_noise`?",
}


def suggests_names(method: Callable[P, T]) -> Callable[P, T]:
    """
    Decorate a method so that the error for an unknown keyword argument has its value and a remedy.

    :param method: the method, without ``**kwargs``
    :return: the method, of the same signature
    """
    known = set(inspect.signature(method).parameters) - {"self"}

    @functools.wraps(method)
    def checked(*args: P.args, **kwargs: P.kwargs) -> T:
        if kwargs.keys() - known:
            owner: type[Any] = type(args[0])
            in_constructor = dict.fromkeys(constructor_argument_names(owner), "Give it to the constructor.")
            check_names(f"{owner.__name__}.{method.__name__}", kwargs, known, in_constructor)
        return method(*args, **kwargs)

    return checked


def check_names(called: str, given: Mapping[str, Any], known: set[str], remedies: Mapping[str, str]) -> None:
    """
    Refuse keyword arguments that are unknown.

    :param called: what is called, such as ``CGP.learn``
    :param given: the keyword arguments
    :param known: the names that are allowed
    :param remedies: sentences for names that are known to be given by mistake
    :raises TypeError: naming the first one, its value and the remedy, and the others
    """
    unknown = [name for name in given if name not in known]
    if unknown:
        public = {name for name in known if not name.startswith("_")}
        error = unknown_argument(called, unknown[0], given[unknown[0]], public, remedies, cutoff=SIMILAR)
        others = ", ".join(f"`{name}`" for name in unknown[1:])
        raise TypeError(f"{error} It does not take {others} either.") if others else error


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
        # Python 3.13 adds a suggestion to it
        found = re.match(r"(.+?)\.__init__\(\) got an unexpected keyword argument '(\w+)'", str(error))
        policy, algorithm = model.policy_class, type(model)
        # Other constructors within the policy's, such as those of features extractors, have arguments of the same names
        if found is None or found[1] not in {each.__qualname__ for each in policy.__mro__}:
            raise
        name, outside = found[2], constructor_argument_names(algorithm)
        known = constructor_argument_names(policy) - GIVEN_BY_ALGORITHM - outside
        remedies = LEAVE_OUT | dict.fromkeys(outside, f"Give it to `{algorithm.__name__}`, outside `policy_kwargs`.")
        value = model.policy_kwargs.get(name)
        raise unknown_argument(policy.__name__, name, value, known, remedies, cutoff=SIMILAR) from error
