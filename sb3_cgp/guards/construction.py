"""Arguments of the constructor that SB3 does not check, or refuses by an error that does not name them."""

import os
from collections.abc import Callable, Mapping
from numbers import Integral
from typing import Any

from gymnasium import spaces
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import get_device
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from sb3_cgp.common.rules import nearest, require, require_count
from sb3_cgp.guards.names import naming_policy_argument

ENVIRONMENT = "the name of a registered environment, a Gymnasium environment, or a VecEnv"


class ConstructionGuard(OffPolicyAlgorithm):
    """
    An algorithm that checks its constructor's arguments before SB3 uses them.

    ``load`` and ``set_env`` take the name of an environment, as the constructor does.
    """

    def __init__(self, policy: Any, env: Any, *args: Any, **kwargs: Any):
        check_constructor_arguments(kwargs)
        if kwargs.get("seed") is not None:
            # Python's random generator takes no integer of NumPy's
            kwargs["seed"] = int(kwargs["seed"])
        super().__init__(policy, env, *args, **kwargs)

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
        remedy = f": write `{env.__name__}(...)`, with its arguments" if isinstance(env, type) else ""
        is_environment = isinstance(env, str) or (hasattr(env, "step") and not isinstance(env, type))
        require(is_environment, "env", env, f"{ENVIRONMENT}{remedy}")
        return super()._wrap_env(maybe_make_env(env, verbose), verbose, monitor_wrapper)

    def _setup_model(self) -> None:
        allowed = f"a class of policies, or one of {', '.join(map(repr, self.policy_aliases))}"
        require(isinstance(self.policy_class, type), "policy", self.policy_class, allowed)
        # `load` sets the spaces where there is no environment
        space = getattr(self, "observation_space", None)
        require(space is not None, "env", None, f"{ENVIRONMENT}: only `load` needs none")
        is_multi_input = self.policy_class is self.policy_aliases.get("MultiInputPolicy")
        allowed = f"'MlpPolicy', or 'CnnPolicy' for images: the observation space is no Dict, but {space}"
        require(isinstance(space, spaces.Dict) or not is_multi_input, "policy", "MultiInputPolicy", allowed)
        check_policy_arguments(self.policy_kwargs)
        with naming_policy_argument(self):
            super()._setup_model()


def check_constructor_arguments(given: Mapping[str, Any]) -> None:
    """
    Check the types of arguments of SB3's constructors.

    :param given: arguments by their names
    :raises ValueError: naming the first argument that breaks a rule, its value and what is allowed
    """
    for name, (holds, allowed) in RULES.items():
        if name in given:
            require(holds(given[name]), name, given[name], allowed)
    device = given.get("device", "auto")
    try:
        get_device(device)
    except (RuntimeError, TypeError) as error:
        allowed = "'auto', a device of PyTorch's such as 'cpu', 'cuda', 'cuda:0' or 'mps', or a torch.device"
        raise ValueError(f"The value of `device` is {device!r}, but must be {allowed}.") from error


def check_policy_arguments(given: Mapping[str, Any]) -> None:
    """
    Check the arguments of SB3's policies whose wrong types end in errors that do not name them.

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
        require(is_none_or_dict(given.get(name)), f"policy_kwargs['{name}']", given.get(name), "None or a dictionary")
    if "n_critics" in given:
        require_count("policy_kwargs['n_critics']", given["n_critics"])
    architecture = given.get("net_arch")
    allowed = "None, a list of integers >= 1 such as [256, 256], or two of them, dict(pi=[64, 64], qf=[256, 256])"
    require(_is_architecture(architecture), "policy_kwargs['net_arch']", architecture, allowed)


def _is_architecture(value: Any) -> bool:
    if isinstance(value, dict):
        return value.keys() == {"pi", "qf"} and all(each is not None and _is_architecture(each) for each in value.values())
    if value is None:
        return True
    return isinstance(value, list) and all(is_integer(width) and width >= 1 for width in value)


def is_integer(value: Any) -> bool:
    """Return whether a value is an integer of Python's or NumPy's."""
    return isinstance(value, Integral)


def is_none_or_dict(value: Any) -> bool:
    """Return whether a value is None or a dictionary."""
    return value is None or isinstance(value, dict)


# By the names of SB3's arguments: the rule, and what it allows
RULES: dict[str, tuple[Callable[[Any], bool], str]] = {
    "verbose": (is_integer, "an integer: 0 for no output, 1 for the log, 2 for debug messages"),
    "seed": (
        lambda value: value is None or (is_integer(value) and 0 <= value < 2**32),
        "None or an integer within [0, 2**32)",
    ),
    "stats_window_size": (lambda value: is_integer(value) and value >= 1, "an integer >= 1"),
    "tensorboard_log": (lambda value: value is None or isinstance(value, str | os.PathLike), "None or the path of a folder"),
    "policy_kwargs": (is_none_or_dict, "None or a dictionary, such as dict(net_arch=[64, 64])"),
    "replay_buffer_kwargs": (is_none_or_dict, "None or a dictionary, such as dict(n_sampled_goal=4)"),
    "replay_buffer_class": (
        lambda value: value is None or (isinstance(value, type) and issubclass(value, ReplayBuffer)),
        "None or a class of replay buffers, such as stable_baselines3.HerReplayBuffer",
    ),
    "optimize_memory_usage": (lambda value: isinstance(value, bool), "True or False"),
}
