"""Arguments of the constructor that SB3 does not check, or refuses by an error that does not name them."""

import functools
import inspect
import os
from collections.abc import Callable, Mapping
from numbers import Real
from typing import Any, ParamSpec, TypeVar

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import get_device
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from sb3_cgp.common.rules import nearest, require, require_count
from sb3_cgp.common.sb3_arguments import constructor_argument_names
from sb3_cgp.guards.names import ELSEWHERE, LEAVE_OUT, check_names, naming_policy_argument

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


class ConstructionGuard(OffPolicyAlgorithm):
    """
    An algorithm that explains wrong policies, arguments of policies and environments when it is made or loaded.

    ``load`` and ``set_env`` take the name of an environment, as the constructor does, and make one.
    """

    def _get_policy_from_name(self, policy_name: str) -> type[BasePolicy]:
        known = ", ".join(map(repr, self.policy_aliases))
        similar = nearest(policy_name, self.policy_aliases)
        advice = "" if similar is None else f" Did you mean {similar!r}?"
        if policy_name not in self.policy_aliases:
            raise ValueError(
                f"The value of `policy` is {policy_name!r}, but must be one of {known}, or a class of policies.{advice}"
            )
        return super()._get_policy_from_name(policy_name)

    # SB3 has no public method that `load`, `set_env` and the constructor share. Its method is a static one, which could not
    # call that of its base class.
    @classmethod
    def _wrap_env(cls, env: GymEnv | str, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        remedy = ""
        if isinstance(env, type):
            remedy = f": write `{env.__name__}(...)`, with its arguments"
        elif isinstance(env, gym.vector.VectorEnv):
            remedy = ", which SB3's `make_vec_env(name, n_envs=N)` makes"
        elif callable(env) and not hasattr(env, "step"):
            remedy = ", which `make_vec_env(function)` makes"
        require(not remedy and (isinstance(env, str) or hasattr(env, "step")), "env", env, f"{ENVIRONMENT}{remedy}")
        return super()._wrap_env(maybe_make_env(env, verbose), verbose, monitor_wrapper)

    def _setup_model(self) -> None:
        allowed = f"a class of policies, or one of {', '.join(map(repr, self.policy_aliases))}"
        require(isinstance(self.policy_class, type), "policy", self.policy_class, allowed)
        # `load` sets the spaces where there is no environment
        has_space = getattr(self, "observation_space", None) is not None
        require(has_space, "env", None, f"{ENVIRONMENT}: only `load` needs none")
        try:
            with naming_policy_argument(self):
                super()._setup_model()
        except Exception as error:
            # Not beforehand, as a policy of the user's own may take other values
            self._explain_policy(error)
            raise

    def _explain_policy(self, error: Exception) -> None:
        """Raise an error that names the policy, or the first of its arguments, that breaks a rule of SB3's policies."""
        try:
            multi_input = self.policy_aliases.get("MultiInputPolicy")
            is_multi_input = multi_input is not None and issubclass(self.policy_class, multi_input)
            is_shared = multi_input is self.policy_aliases.get("MlpPolicy")
            if is_multi_input and not is_shared and "features_extractor_class" not in self.policy_kwargs:
                allowed = f"'MlpPolicy', or 'CnnPolicy' for images: the observation space is {self.observation_space}"
                is_dict = isinstance(self.observation_space, spaces.Dict)
                require(is_dict, "policy", self.policy_class.__name__, allowed)
            check_policy_arguments(self.policy_kwargs)
        except ValueError as explanation:
            raise explanation from error


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
