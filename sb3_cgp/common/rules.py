"""Every rule on the arguments of the package, in one place. Imports nothing of ours."""

import math
from collections.abc import Iterable
from numbers import Integral, Real
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.noise import ActionNoise, VectorizedActionNoise

CEM_RESULTS = ("best", "mean")
POLICY_LOSSES = ("cgp", "qgp", None)
POLICY_TRAININGS = ("online", "offline")
INFERENCES = ("actor", "averaged_actor", "cem")
SCORING_DTYPES = ("auto", "float32", "bfloat16")
LINEAR_SCHEDULE_PREFIX = "lin_"
LARGEST_FLOAT32 = np.finfo(np.float32).max


def require(condition: bool, name: str, value: Any, allowed: str) -> None:
    """
    Refuse an argument that breaks a rule.

    :param condition: whether the rule holds
    :param name: the argument's name
    :param value: the argument's value
    :param allowed: what is allowed, completing "must be ..."
    :raises ValueError: if the rule does not hold
    """
    if not condition:
        raise ValueError(f"The value of `{name}` is {value!r}, but must be {allowed}.")


def require_count(name: str, value: Any, minimum: int = 1) -> None:
    """
    Refuse anything but an integer of at least ``minimum``.

    :param name: the argument's name
    :param value: the argument's value
    :param minimum: the smallest value that is allowed
    :raises ValueError: if the value is not such an integer
    """
    is_integer = isinstance(value, Integral) and not isinstance(value, bool)
    require(is_integer and value >= minimum, name, value, f"an integer >= {minimum}")


def require_number(name: str, value: Any, low: float = 0.0, high: float = math.inf) -> None:
    """
    Refuse anything but a finite number within ``[low, high]``.

    :param name: the argument's name
    :param value: the argument's value
    :param low: the smallest value that is allowed
    :param high: the largest value that is allowed
    :raises ValueError: if the value is not such a number
    """
    is_number = isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
    allowed = f"a finite number >= {low:g}" if math.isinf(high) else f"a number within [{low:g}, {high:g}]"
    require(is_number and low <= value <= high, name, value, allowed)


def require_choice(name: str, value: Any, choices: Iterable[Any]) -> None:
    """
    Refuse anything that is not among ``choices``.

    :param name: the argument's name
    :param value: the argument's value
    :param choices: the values that are allowed
    :raises ValueError: if the value is not one of them
    """
    choices = list(choices)
    require(value in choices, name, value, "one of " + ", ".join(repr(choice) for choice in choices))


def check_cem(iterations: Any, samples: Any, elites: Any, result: Any, prefix: str = "") -> None:
    """
    Check the arguments of the Cross-Entropy Method.

    :param iterations: number of iterations, an integer >= 1
    :param samples: number of samples per iteration, an integer >= 1
    :param elites: number of samples kept per iteration, from 1 to ``samples``
    :param result: "best" or "mean"
    :param prefix: put before each argument's name in an error, ``cem_`` where the user wrote it so
    :raises ValueError: naming the first argument that breaks a rule
    """
    require_count(f"{prefix}iterations", iterations)
    require_count(f"{prefix}samples", samples)
    require_count(f"{prefix}elites", elites)
    require(elites <= samples, f"{prefix}elites", elites, f"at most `{prefix}samples`, which is {samples}")
    require_choice(f"{prefix}result", result, CEM_RESULTS)


def check_action_space(action_space: spaces.Space) -> None:
    """
    Check that CEM can search an action space: a box, bounded in every dimension.

    :param action_space: the environment's action space
    :raises ValueError: if it is of another kind, unbounded or empty
    """
    require(isinstance(action_space, spaces.Box), "action_space", action_space, "a gymnasium.spaces.Box")
    low, high = action_space.low, action_space.high  # type: ignore[attr-defined]
    bounded = low.size > 0 and bool(np.all(np.isfinite(low)) and np.all(np.isfinite(high)) and np.all(low < high))
    require(bounded, "action_space", action_space, "bounded: finite low < high in every dimension, and at least one")


def check_learning_rate(name: str, value: Any) -> None:
    """
    Check a learning rate: a number, a schedule, or a linear schedule spelt ``lin_<initial value>``, as in rl_zoo3.

    Zero is allowed: rl_zoo3 loads models with it to watch them.

    :param name: the argument's name
    :param value: the argument's value
    :raises ValueError: if it is none of these, or negative
    """
    if callable(value):
        return
    if isinstance(value, str):
        prefix, _, initial_value = value.partition("_")
        try:
            valid = f"{prefix}_" == LINEAR_SCHEDULE_PREFIX and 0.0 <= float(initial_value) < math.inf
        except ValueError:
            valid = False
        require(valid, name, value, f"a number >= 0, a schedule, or a string such as '{LINEAR_SCHEDULE_PREFIX}1e-3'")
        return
    require_number(name, value)


def check_train_freq(value: Any) -> None:
    """
    Check ``train_freq``: a count of steps, or a pair of a count and its unit.

    :param value: the argument's value
    :raises ValueError: if the count is not an integer >= 1 or the unit is unknown
    """
    is_pair = isinstance(value, tuple) and len(value) == 2
    frequency, unit = value if is_pair else (value, "step")
    # SB3 takes no NumPy integer here
    require(isinstance(frequency, int), "train_freq", value, "an int, or a tuple of an int and a unit")
    require_count("train_freq", frequency)
    require(getattr(unit, "value", unit) in ("step", "episode"), "train_freq", value, "in unit 'step' or 'episode'")


def check_action_noise(action_noise: ActionNoise | None) -> None:
    """
    Refuse exploration noise of a negative standard deviation.

    :param action_noise: the exploration noise, if any
    :raises ValueError: if its standard deviation is negative
    """
    if isinstance(action_noise, VectorizedActionNoise):
        action_noise = action_noise.base_noise
    # SB3 gives no public access to a noise's standard deviation
    sigma = getattr(action_noise, "_sigma", 0.0)
    require(bool(np.all(np.asarray(sigma) >= 0.0)), "action_noise", action_noise, "noise of standard deviation >= 0")


def check_finite(name: str, values: Any, timestep: int) -> None:
    """
    Stop the training at the first value that the environment returns and that is NaN or infinite, in float32.

    :param name: what the values are
    :param values: an array, or arrays by key
    :param timestep: the environment step
    :raises ValueError: if a value is NaN or infinite
    """
    for key, array in values.items() if isinstance(values, dict) else [(None, values)]:
        # False for NaN, too
        if not np.all(np.abs(array) <= LARGEST_FLOAT32):
            which = name if key is None else f"{name} `{key}`"
            raise ValueError(
                f"The environment returned a NaN or infinite (in float32) {which} at environment step {timestep}: {array}. "
                "It was not stored, and the networks are as before it."
            )


def check_cgp(model: Any) -> None:
    """
    Check every argument of :class:`~sb3_cgp.core.cgp.CGP`.

    It looks at the model rather than at the constructor's arguments, as ``load`` bypasses the constructor.

    :param model: the model, its arguments set and its networks not yet built
    :raises ValueError: naming the first argument that breaks a rule, its value and what is allowed
    """
    check_action_space(model.action_space)
    check_cem(model.cem_iterations, model.cem_samples, model.cem_elites, model.cem_result, prefix="cem_")
    require_choice("cem_dtype", model.cem_dtype, SCORING_DTYPES)
    require(isinstance(model.cuda_graphs, bool), "cuda_graphs", model.cuda_graphs, "True or False")
    for name in ("batch_size", "buffer_size", "n_steps", "policy_delay", "target_update_interval"):
        require_count(name, getattr(model, name))
    require_count("learning_starts", model.learning_starts, minimum=0)
    require_count("gradient_steps", model.gradient_steps, minimum=-1)
    check_train_freq(model.train_freq)
    for name in ("tau", "gamma"):
        require_number(name, getattr(model, name), high=1.0)
    for name in ("target_policy_noise", "target_noise_clip"):
        require_number(name, getattr(model, name))
    check_action_noise(model.action_noise)
    check_learning_rate("learning_rate", model.learning_rate)
    if model.actor_learning_rate is not None:
        check_learning_rate("actor_learning_rate", model.actor_learning_rate)
    _check_variant(model)


def _check_variant(model: Any) -> None:
    """Check the choice of a policy's loss, training and inference, and that they go together."""
    require_choice("policy_loss", model.policy_loss, POLICY_LOSSES)
    require_choice("policy_training", model.policy_training, POLICY_TRAININGS)
    require_choice("inference", model.inference, INFERENCES)
    for name in ("inference", "cem_dtype"):
        value = model.policy_kwargs.get(name)
        require(value is None, f"policy_kwargs['{name}']", value, f"given as `{name}`, outside them")
    if model.policy_loss is None:
        require(
            model.policy_training == "online", "policy_training", model.policy_training, "'online' without a `policy_loss`"
        )
        require(model.inference == "cem", "inference", model.inference, "'cem' where `policy_loss=None` trains no actor")
    shares_extractor = bool(model.policy_kwargs.get("share_features_extractor", False))
    trains_actor_online = model.policy_loss is not None and model.policy_training == "online"
    require(
        trains_actor_online or not shares_extractor,
        "share_features_extractor",
        shares_extractor,
        "False unless the policy is trained online: a shared extractor learns from the policy's loss alone",
    )
