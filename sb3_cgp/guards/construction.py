"""Arguments of the constructor that SB3 does not check, or refuses by an error that does not name them."""

import functools
import inspect
import os
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from numbers import Real
from typing import Any, ParamSpec, TypeVar

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import NatureCNN
from stable_baselines3.common.utils import get_device
from torch import nn

from sb3_cgp.common.rules import nearest, require, require_count
from sb3_cgp.common.sb3_arguments import constructor_argument_names
from sb3_cgp.guards.argument_names import ELSEWHERE, LEAVE_OUT, check_names, naming_policy_argument

P = ParamSpec("P")
T = TypeVar("T")

ENVIRONMENT = "the name of a registered environment, a Gymnasium environment, or a VecEnv"


def checks_arguments(constructor: Callable[P, T]) -> Callable[P, T]:
    """
    Decorate the constructor of an algorithm so that it refuses unknown arguments, and wrong values of SB3's arguments.

    :param constructor: the method ``__init__``, without ``**kwargs``
    :return: the method, of the same signature
    """
    signature = inspect.signature(constructor)

    @functools.wraps(constructor)
    def checked(*args: P.args, **kwargs: P.kwargs) -> T:
        algorithm: type[Any] = type(args[0])
        if kwargs.keys() - signature.parameters.keys():
            known = constructor_argument_names(algorithm) - {"self"}
            check_names(algorithm.__name__, kwargs, known, LEAVE_OUT | ELSEWHERE)
        check_constructor_arguments(signature.bind_partial(*args, **kwargs).arguments)
        return constructor(*args, **kwargs)

    return checked


def check_env(env: Any) -> None:
    """
    Refuse what is no environment.

    :param env: the environment, or its name
    :raises ValueError: naming it, and the remedy
    """
    remedy = ""
    if isinstance(env, type):
        remedy = f": write `{env.__name__}(...)`, with its arguments"
    elif isinstance(env, gym.vector.VectorEnv):
        remedy = ", which SB3's `make_vec_env(name, n_envs=N)` makes"
    elif callable(env) and not hasattr(env, "step"):
        remedy = ", which `make_vec_env(function)` makes"
    require(not remedy and (isinstance(env, str) or hasattr(env, "step")), "env", env, f"{ENVIRONMENT}{remedy}")


def check_policy_name(name: str, aliases: Mapping[str, type[BasePolicy]]) -> None:
    """
    Refuse a name that is none of an algorithm's policies'.

    :param name: the policy's name
    :param aliases: the policies by their names
    :raises ValueError: with the nearest name
    """
    similar = nearest(name, aliases)
    advice = "" if similar is None else f" Did you mean {similar!r}?"
    if name not in aliases:
        known = ", ".join(map(repr, aliases))
        raise ValueError(f"The value of `policy` is {name!r}, but must be one of {known}, or a class of policies.{advice}")


def check_policy_and_env(model: OffPolicyAlgorithm) -> None:
    """
    Check that a model whose networks are to be made has a class of policies, and spaces, and counts its environments.

    :param model: the model
    :raises ValueError: if the policy is no class, there is no environment, or ``load`` was given another number of them
    """
    allowed = f"a class of policies, or one of {', '.join(map(repr, model.policy_aliases))}"
    require(isinstance(model.policy_class, type), "policy", model.policy_class, allowed)
    # `load` sets the spaces where there is no environment
    has_space = getattr(model, "observation_space", None) is not None
    require(has_space, "env", None, f"{ENVIRONMENT}: only `load` needs none")
    n_envs = model.n_envs if model.env is None else model.env.num_envs
    require(model.n_envs == n_envs, "n_envs", model.n_envs, f"left out, or {n_envs}, as many as `env` has")


@contextmanager
def explaining_policy(model: OffPolicyAlgorithm) -> Iterator[None]:
    """
    Raise an error that names the policy, or one of its arguments that breaks a rule, in place of one that does not.

    Not beforehand, as a policy of the user's own may take other arguments and values.

    :param model: the model whose policy is made within the context
    :raises ValueError: if the policy is for other observations, the value of an argument of SB3's policies is wrong, or
        PyTorch's default data type is not float32
    :raises TypeError: if the policy takes no such argument
    """
    try:
        with naming_policy_argument(model):
            yield
    except Exception as error:
        try:
            _check_policy(model)
            _check_images(error)
        except ValueError as explanation:
            raise explanation from error
        raise


def _check_policy(model: OffPolicyAlgorithm) -> None:
    """Check that SB3's policy for ``Dict`` observations is given such, the arguments of SB3's policies, and the data type."""
    multi_input = model.policy_aliases.get("MultiInputPolicy")
    is_multi_input = multi_input is not None and issubclass(model.policy_class, multi_input)
    is_shared = multi_input is model.policy_aliases.get("MlpPolicy")
    if is_multi_input and not is_shared and "features_extractor_class" not in model.policy_kwargs:
        allowed = f"'MlpPolicy', or 'CnnPolicy' for images: the observation space is {model.observation_space}"
        is_dict = isinstance(model.observation_space, spaces.Dict)
        require(is_dict, "policy", model.policy_class.__name__, allowed)
    check_policy_arguments(model.policy_kwargs)
    allowed = (
        "torch.float32, of which SB3's tensors are: call `torch.set_default_dtype(torch.float32)` before the model is made"
    )
    require(th.get_default_dtype() == th.float32, "torch.get_default_dtype()", th.get_default_dtype(), allowed)


def _check_images(error: Exception) -> None:
    """Name the images if the error is that they are too small for SB3's ``NatureCNN``."""
    for frame, _ in traceback.walk_tb(error.__traceback__):
        if frame.f_code is NatureCNN.__init__.__code__ and "Kernel size can't be greater" in str(error):
            allowed = (
                "of images of at least 36 x 36 pixels for SB3's NatureCNN: enlarge them, as "
                "`gymnasium.wrappers.ResizeObservation(env, (84, 84))` does, or give another features extractor, "
                "`policy_kwargs=dict(features_extractor_class=...)`"
            )
            require(False, "observation_space", frame.f_locals["observation_space"], allowed)


def check_constructor_arguments(given: Mapping[str, Any]) -> None:
    """
    Check the values of arguments of SB3's constructors.

    :param given: arguments by their names
    :raises ValueError: naming the first argument that breaks a rule, its value and what is allowed
    """
    for name, (holds, allowed) in RULES.items():
        if name in given:
            require(holds(given[name]), name, given[name], allowed)
    device = given.get("device", "auto")
    try:
        th.empty(0, device=get_device(device))
    except Exception as error:
        allowed = "'auto', or a device that PyTorch can use here, such as 'cpu' or, on a GPU, 'cuda'"
        raise ValueError(f"The value of `device` is {device!r}, but must be {allowed}.") from error


def check_policy_arguments(given: Mapping[str, Any]) -> None:
    """
    Check arguments of SB3's policies whose wrong values end in errors that do not name them.

    :param given: ``policy_kwargs``
    :raises ValueError: naming the first argument that breaks a rule
    """
    for name, example in (
        ("activation_fn", "torch.nn.ReLU"),
        ("optimizer_class", "torch.optim.Adam"),
        ("features_extractor_class", "stable_baselines3.common.torch_layers.FlattenExtractor"),
    ):
        # A function may make one, too
        is_valid = callable(value := given.get(name, object)) and not isinstance(value, nn.Module)
        require(is_valid, f"policy_kwargs['{name}']", value, f"a class, such as {example}, and no name or instance")
    for name in ("optimizer_kwargs", "features_extractor_kwargs"):
        is_valid = isinstance(given.get(name, {}), Mapping | None)
        require(is_valid, f"policy_kwargs['{name}']", given.get(name), "None or a dictionary")
    rate = (given.get("optimizer_kwargs") or {}).get("lr")
    require(rate is None, "policy_kwargs['optimizer_kwargs']['lr']", rate, "left out: give `learning_rate` to the algorithm")
    if "n_critics" in given:
        require_count("policy_kwargs['n_critics']", given["n_critics"])
    architecture = given.get("net_arch")
    allowed = "None, a list of integers >= 1 such as [256, 256], or two of them, dict(pi=[64, 64], qf=[256, 256])"
    # SB3 takes tuples within a dictionary alone, and ignores further keys
    parts = [architecture.get("pi"), architecture.get("qf")] if isinstance(architecture, Mapping) else [architecture]
    is_valid = not isinstance(architecture, tuple) and all(map(_is_list_of_widths, parts))
    require(architecture is None or is_valid, "policy_kwargs['net_arch']", architecture, allowed)


def _is_list_of_widths(value: Any) -> bool:
    if not isinstance(value, list | tuple):
        return False
    return all(isinstance(width, int | np.integer) and not isinstance(width, bool) and width >= 1 for width in value)


def _is_flag(value: Any) -> bool:
    return value is None or isinstance(value, int | np.integer | np.bool_)


def _is_seed(value: Any) -> bool:
    return value is None or (isinstance(value, int | np.integer) and 0 <= int(value) < 2**32)


# By the names of SB3's arguments: the rule, and what it allows
RULES: dict[str, tuple[Callable[[Any], bool], str]] = {
    "verbose": (lambda value: isinstance(value, Real | np.bool_), "0 for no output, 1 for the log, or 2 for debug messages"),
    "seed": (_is_seed, "None or an integer within [0, 2**32)"),
    # `learn` makes a queue of this length, which takes no integer of NumPy's
    "stats_window_size": (lambda value: value is None or (isinstance(value, int) and value >= 0), "an int >= 0, or None"),
    "tensorboard_log": (lambda value: isinstance(value, str | os.PathLike | None), "None or the path of a folder"),
    "policy_kwargs": (
        lambda value: isinstance(value, Mapping | None),
        "None or a dictionary, such as dict(net_arch=[64, 64])",
    ),
    "replay_buffer_kwargs": (lambda value: isinstance(value, Mapping | None), "None or a dictionary"),
    "replay_buffer_class": (
        lambda value: isinstance(value, type | None),
        "None or a class of replay buffers, such as stable_baselines3.HerReplayBuffer",
    ),
    "optimize_memory_usage": (_is_flag, "True or False"),
}
