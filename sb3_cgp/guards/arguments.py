"""Arguments of a wrong type or name, which SB3 ignores or answers with an error far from its cause."""

import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from numbers import Real
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback, EventCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_cgp.common.load_arguments import SavedModel, check_load_arguments, misspelt_custom_objects
from sb3_cgp.common.rules import as_count, require
from sb3_cgp.common.sb3_arguments import check_train_freq
from sb3_cgp.guards.construction import check_constructor_arguments

# The attributes in which SB3's classes hold other callbacks
SLOTS = {CallbackList: "callbacks", EventCallback: "callback", EvalCallback: "callback_on_new_best"}
# The beginning of SB3's error for other policy_kwargs than the saved ones, and what to do about it
OTHER_POLICY_KWARGS = "The specified policy kwargs do not equal"
LEAVE_POLICY_KWARGS_OUT = (
    "Leave `policy_kwargs` out, as a loaded model has those that it was saved with, and set what can be changed on its "
    "policy, such as `model.policy.selector = ...`."
)
CALLBACK = "an instance of a subclass of BaseCallback"


def check_learn_arguments(model: OffPolicyAlgorithm, total_timesteps: Any, callback: Any, log_interval: Any) -> int:
    """
    Check the arguments of ``learn``, and ``train_freq``, which may have been set on the model.

    :param model: the model
    :param total_timesteps: number of environment steps, an integer >= 0, or an equal float such as 1e5
    :param callback: callback(s) called at every step with state of the algorithm.
    :param log_interval: number of episodes between two writings of the log; None for no writing
    :return: the number of environment steps
    :raises ValueError: naming the first argument that is wrong, its value and what is allowed
    """
    is_infinite = isinstance(total_timesteps, float) and total_timesteps == math.inf
    advice = ": for a training that a callback ends, give a large one such as 10**12" if is_infinite else ""
    count = as_count("total_timesteps", total_timesteps, advice=advice)
    check_callback(callback)
    # SB3 converts it when the model is made, by this private method, and not again.
    check_train_freq(model.train_freq, model.n_envs)
    model._convert_train_freq()
    allowed = "a number of episodes other than 0, or None to write no log"
    is_interval = log_interval is None or (isinstance(log_interval, Real) and log_interval != 0)
    require(is_interval, "log_interval", log_interval, allowed)
    return count


def effective_load_arguments(
    algorithm: type[OffPolicyAlgorithm],
    saved: SavedModel,
    device: Any,
    custom_objects: dict[str, Any] | None,
    given: dict[str, Any],
) -> dict[str, Any]:
    """
    Check the arguments of ``load``, and warn of those without effect.

    :param algorithm: the algorithm's class
    :param saved: the path of the saved model, or an open file
    :param device: the argument ``device``
    :param custom_objects: the argument ``custom_objects``
    :param given: the arguments to change in the model
    :return: those that have an effect, by the names that SB3 has for them
    :raises TypeError: if a model has no such argument or attribute, naming it and the nearest one that is allowed
    :raises ValueError: if the value of an argument of SB3's is wrong, naming it
    """
    check_load_arguments(algorithm, saved, given)
    check_constructor_arguments(given | {"device": device})
    effective = dict(given)
    if "policy" in effective:
        message = (
            f"`policy={effective.pop('policy')!r}` has no effect: a loaded model keeps the policy that it was saved with."
        )
        warnings.warn(message, stacklevel=3)
    if "stats_window_size" in effective:
        # SB3 keeps this argument under another name
        effective["_stats_window_size"] = effective.pop("stats_window_size")
    for name, similar in misspelt_custom_objects(saved, custom_objects or {}).items():
        message = f"custom_objects[{name!r}] has no effect, as the saved model has no such attribute: {similar!r}?"
        warnings.warn(message, stacklevel=3)
    return effective


@contextmanager
def explaining_policy_kwargs() -> Iterator[None]:
    """
    Add the remedy to SB3's error for other ``policy_kwargs`` than those of the model that is loaded within the context.

    :raises ValueError: in place of SB3's
    """
    try:
        yield
    except ValueError as error:
        if not str(error).startswith(OTHER_POLICY_KWARGS):
            raise
        raise ValueError(f"{error} {LEAVE_POLICY_KWARGS_OUT}") from error


def check_callback(callback: Any) -> None:
    """
    Check the callback of a training, and the callbacks within SB3's own ones.

    :param callback: the callback, a list of them, a function of the local and global variables, or None
    :raises ValueError: if one of them is a class, or nothing that can be called back
    """
    is_function = callable(callback) and not isinstance(callback, type)
    if callback is None or (is_function and not isinstance(callback, BaseCallback)):
        return
    if not isinstance(callback, list):
        _check_instance("callback", callback, f"{CALLBACK}, a list of them, a function, or None")
    _check_parts("callback", callback)


def _check_parts(name: str, value: Any) -> None:
    """Check the callbacks within a callback or a list."""
    # Not any attribute: that of a user's own callback may hold a class for a purpose of its own
    slots = [slot for kind, slot in SLOTS.items() if isinstance(value, kind)]
    parts = {name: value} if isinstance(value, list) else {f"{name}.{slot}": vars(value).get(slot) for slot in slots}
    for place, content in parts.items():
        named = {f"{place}[{i}]": each for i, each in enumerate(content)} if isinstance(content, list) else {place: content}
        for part_name, part in named.items():
            if part is None and not isinstance(content, list):
                continue
            _check_instance(part_name, part, f"{CALLBACK}; `ConvertCallback(function)` makes one of a function")
            _check_parts(part_name, part)


def _check_instance(name: str, value: Any, allowed: str) -> None:
    """Refuse anything but an instance of a callback."""
    is_class = isinstance(value, type) and issubclass(value, BaseCallback)
    remedy = f": write `{value.__name__}(...)`, with its arguments" if is_class else ""
    require(isinstance(value, BaseCallback), name, value, f"{allowed}{remedy}")
