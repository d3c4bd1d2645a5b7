"""The rules on the arguments that SB3's off-policy algorithms have, and the forms of a learning rate."""

import inspect
import math
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.noise import VectorizedActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import FloatSchedule, LinearSchedule

from sb3_cgp.common.rules import as_count, require, require_count, require_number

LINEAR_SCHEDULE_PREFIX = "lin_"


def constructor_argument_names(of: type) -> set[str]:
    """
    Return the names of the arguments that a constructor takes, those that it passes on to its bases included.

    A base that is not written in Python may not tell its arguments: it adds none.

    :param of: the class, such as that of an algorithm, a policy or an environment
    :return: the names
    """
    names: set[str] = set()
    # In the order in which `super().__init__` goes through the constructors
    for base in of.__mro__:
        if "__init__" not in vars(base):
            continue
        try:
            parameters = inspect.signature(vars(base)["__init__"]).parameters.values()
        except (TypeError, ValueError):
            # Not written in Python, as those of simulators: its arguments have no names
            continue
        own = {each.name for each in parameters if each.kind not in (each.VAR_POSITIONAL, each.VAR_KEYWORD)}
        names |= own
        if len(own) == len(parameters):
            break
    return names


def as_schedule(rate: float | Schedule | str) -> Schedule:
    """
    Convert a learning rate to a schedule.

    :param rate: a number, a schedule, or a string such as ``"lin_1e-3"`` for a linear schedule that ends at 0
    :return: the schedule, a function of the progress remaining
    """
    if isinstance(rate, str):
        return LinearSchedule(float(rate.removeprefix(LINEAR_SCHEDULE_PREFIX)), 0.0, 1.0)
    # SB3 refuses NumPy's numbers
    return FloatSchedule(rate if callable(rate) else float(rate))


def check_learning_rate(name: str, value: Any) -> None:
    """
    Check a learning rate. Zero is allowed, as rl_zoo3 loads models with it to watch them.

    :param name: the argument's name
    :param value: the argument's value
    :raises ValueError: if the value is not a number >= 0, a schedule of such numbers from 1.0 to 0.0, or a string such as
        ``"lin_1e-3"``
    """
    if isinstance(value, str):
        prefix, _, initial_value = value.partition("_")
        try:
            is_valid = f"{prefix}_" == LINEAR_SCHEDULE_PREFIX and 0.0 <= float(initial_value) < math.inf
        except ValueError:
            is_valid = False
        require(is_valid, name, value, f"a number >= 0, a schedule, or a string such as '{LINEAR_SCHEDULE_PREFIX}1e-3'")
    elif callable(value):
        # The last gradient step of a training often has no progress remaining
        for progress_remaining in (1.0, 0.5, 0.0):
            try:
                rate = value(progress_remaining)
            except Exception as error:
                allowed = f"a schedule of numbers from 1.0 to 0.0; at {progress_remaining} it raises {error!r}"
                require(False, name, value, allowed)
            # As SB3 does, which takes an array or a tensor of one number too
            is_single = isinstance(rate, np.ndarray | th.Tensor) and math.prod(rate.shape) == 1
            require_number(f"{name}({progress_remaining})", rate.item() if is_single else rate)
    else:
        require_number(name, value)


def check_train_freq(value: Any, n_envs: int = 1) -> None:
    """
    Check ``train_freq``: a number of steps, or a pair of a number and its unit.

    :param value: the argument's value
    :param n_envs: number of environments
    :raises ValueError: if the number is not an integer >= 1, or the unit is unknown, or "episode" for several environments
    """
    is_pair = isinstance(value, tuple) and len(value) == 2
    frequency, unit = value if is_pair else (value, "step")
    unit = getattr(unit, "value", unit)
    # SB3 accepts no NumPy integer here
    require(isinstance(frequency, int), "train_freq", value, "an int, or a tuple of an int and a unit")
    require_count("train_freq", frequency)
    require(unit in ("step", "episode"), "train_freq", value, "in unit 'step' or 'episode'")
    allowed = f"in unit 'step' with {n_envs} environments, whose episodes do not end together"
    require(n_envs == 1 or unit == "step", "train_freq", value, allowed)


def replay_buffer_class_of(model: OffPolicyAlgorithm) -> type[ReplayBuffer]:
    """
    Return the class of a model's replay buffer: the given one, or that which SB3 chooses.

    :param model: the model, with the arguments of the constructor
    :return: the class
    """
    if model.replay_buffer_class is not None:
        return model.replay_buffer_class
    if isinstance(model.observation_space, spaces.Dict):
        return DictReplayBuffer
    return NStepReplayBuffer if model.n_steps > 1 else ReplayBuffer


def check_off_policy_arguments(model: OffPolicyAlgorithm) -> None:
    """
    Check the arguments that an algorithm has from SB3's ``OffPolicyAlgorithm``, as attributes of the model.

    :param model: the model, before its networks are built; a ``learning_starts`` such as 1e4 becomes an integer
    :raises ValueError: naming the first argument that breaks a rule, its value and what is allowed
    """
    for name in ("batch_size", "buffer_size", "n_steps"):
        require_count(name, getattr(model, name))
    # The only one of these counts that SB3 takes as a float
    model.learning_starts = as_count("learning_starts", model.learning_starts)
    require_count("gradient_steps", model.gradient_steps, minimum=-1)
    check_train_freq(model.train_freq, model.n_envs)
    for name in ("tau", "gamma"):
        require_number(name, getattr(model, name), high=1.0)
    check_learning_rate("learning_rate", model.learning_rate)
    noise = model.action_noise.base_noise if isinstance(model.action_noise, VectorizedActionNoise) else model.action_noise
    # SB3 has no public attribute for the standard deviation of an action noise
    is_valid = bool(np.all(np.asarray(getattr(noise, "_sigma", 0.0)) >= 0.0))
    require(is_valid, "action_noise", noise, "noise of standard deviation >= 0")
    # Where SB3 chooses the replay buffer, it asserts this
    has_dict = isinstance(model.observation_space, spaces.Dict)
    allowed = "1 with a Dict observation space, for which SB3 has no n-step replay buffer"
    is_chosen = model.replay_buffer_class is None
    require(model.n_steps == 1 or not has_dict or not is_chosen, "n_steps", model.n_steps, allowed)
    # SB3's buffers refuse these too, one of them at the first gradient step only
    has_no_such_mode = issubclass(replay_buffer_class_of(model), DictReplayBuffer | NStepReplayBuffer)
    is_supported = not model.optimize_memory_usage or not has_no_such_mode
    allowed = "False with a Dict observation space or `n_steps` above 1, for which SB3's replay buffers have no such mode"
    require(is_supported, "optimize_memory_usage", model.optimize_memory_usage, allowed)
