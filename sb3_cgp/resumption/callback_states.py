"""The states of callbacks, and of the environments that they evaluate on."""

import warnings
from collections import Counter
from collections.abc import Mapping
from typing import Any, NamedTuple

import gymnasium as gym
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_cgp.common.sb3_arguments import constructor_argument_names
from sb3_cgp.resumption.declarations import METHODS, full_name
from sb3_cgp.resumption.environments import is_part_of, restore_environment, state_and_obstacles
from sb3_cgp.resumption.fingerprints import LEFT_OUT, fingerprint
from sb3_cgp.resumption.plain_data import declared_state, from_plain, plain_attributes, set_plain_attributes

State = dict[str, Any]
Fingerprints = dict[str, bytes | None]
# The attributes of every callback of SB3, which follow from the training
COMMON = {"n_calls", "num_timesteps", "verbose", "locals", "globals", "parent"}
# Packages whose objects show a training's progress, and are made anew
FOR_PEOPLE = {"tqdm", "rich", "matplotlib", "optuna"}


class Start(NamedTuple):
    """
    A callback when the training has started.

    :param attributes: fingerprints of its attributes by name
    :param was_called: whether it has been called before, in an earlier training
    """

    attributes: Fingerprints
    was_called: bool


def iter_callbacks(callback: BaseCallback) -> list[BaseCallback]:
    """
    List a callback and all callbacks within it.

    :param callback: the callback
    :return: the callbacks, without duplicates; each one precedes those within it
    """
    found = [callback]
    # The loop also visits the callbacks that it appends
    for each in found:
        for value in vars(each).values():
            children = value if isinstance(value, list) else [value]
            found += [child for child in children if isinstance(child, BaseCallback) and child not in found]
    return found


def initial_attributes(callback: BaseCallback) -> dict[int, Start]:
    """
    Return the attributes that callbacks have when a training has started, so that those that its steps change can be told.

    :param callback: the training's callback
    :return: the start of each callback by its ``id``
    """
    return {id(each): Start(_fingerprints(each), each.n_calls > 0) for each in iter_callbacks(callback)}


def callback_states(
    callback: BaseCallback, training_env: VecEnv, initial: Mapping[int, Start]
) -> tuple[list[State], list[str]]:
    """
    Return the states of all callbacks, with whether each has changed since the training started, and the obstacles.

    A callback has changed if an attribute differs from that time: one of the constructor's arguments, too, or one that is not
    plain data (:func:`~sb3_cgp.resumption.fingerprints.fingerprint`). One that declares its state has changed if this has
    more than the counters of every callback. Attributes that have not changed are not saved, as the constructor of the
    resumed training's callback may have set them by other arguments.

    :param callback: the training's callback
    :param training_env: the training's environment, which is not saved with a callback
    :param initial: the attributes at the training's start, by :func:`initial_attributes`
    :return: plain data, for each callback in the order of :func:`iter_callbacks`; and a sentence for each part that is lost
    """
    problems: list[str] = []
    # One that the training was given after its start has changed
    unknown, callbacks = Start({}, was_called=True), iter_callbacks(callback)
    return [_callback_state(each, training_env, initial.get(id(each), unknown), problems) for each in callbacks], problems


def restore_callbacks(callback: BaseCallback, states: list[State]) -> None:
    """
    Restore callbacks, which are identified by their class and order.

    :param callback: the callback of the resumed training
    :param states: the states that :func:`callback_states` returned
    :raises ValueError: if the plain data of a state represents an unknown type
    """
    present: dict[tuple[str, int], BaseCallback] = {}
    seen: Counter[str] = Counter()
    for each in iter_callbacks(callback):
        name = full_name(type(each))
        present[name, seen[name]] = each
        seen[name] += 1
    saved: Counter[str] = Counter()
    for state in states:
        name = state["class"]
        found = present.get((name, saved[name]))
        saved[name] += 1
        if found is None:
            if state["environments"] or state["has_changed"]:
                warnings.warn(f"A {name} was among the callbacks, and is not now: what it counted is lost.", stacklevel=2)
            continue
        _restore_callback(found, state)


def _restore_callback(callback: BaseCallback, state: State) -> None:
    if "own" in state:
        callback.set_training_state(from_plain(state["own"]))  # type: ignore[attr-defined]
    else:
        set_plain_attributes(callback, state["attributes"])
    for attribute, environment in state["environments"].items():
        if environment is None:
            message = f"The state of {state['class']}'s `{attribute}` was not saved: its episodes will be other ones."
            warnings.warn(message, stacklevel=2)
        elif isinstance(getattr(callback, attribute, None), VecEnv | gym.Env):
            try:
                restore_environment(getattr(callback, attribute), environment)
            except ValueError as error:
                message = f"{state['class']}'s `{attribute}` is not the saved one, and its episodes will differ: {error}"
                warnings.warn(message, stacklevel=2)


def _callback_state(callback: BaseCallback, training_env: VecEnv, start: Start, problems: list[str]) -> State:
    state: State = {"class": full_name(type(callback)), "environments": {}}
    for name, env in _environments(callback, training_env).items():
        state["environments"][name], obstacles = state_and_obstacles(env)
        if obstacles:
            problems.append(f"The state of {type(callback).__name__}'s `{name}` cannot be saved: {' '.join(obstacles)}")
    if hasattr(callback, "get_training_state"):
        own = callback.get_training_state()
        beyond = own.keys() - COMMON if isinstance(own, dict) else own is not None
        plain = declared_state(f"{state['class']}.get_training_state()", own)
        return state | {"own": plain, "has_changed": bool(beyond)}
    now = _fingerprints(callback)
    unchanged = {name for name, value in now.items() if value is not None and value == start.attributes.get(name)}
    # One that has been called in an earlier training has further values from there
    unsaved = _unsaved(callback) | (set() if start.was_called else unchanged)
    state["attributes"] = plain_attributes(callback, without=unsaved)
    # What one that the training was given after its start has changed is not known
    changed = {name for name, value in now.items() if value is not None} - unchanged if start.attributes else set()
    for name in sorted(changed - state["attributes"].keys() - state["environments"].keys()):
        value = vars(callback)[name]
        if not isinstance(value, LEFT_OUT) and type(value).__module__.split(".")[0] not in FOR_PEOPLE:
            reason = "an argument of its constructor" if name in unsaved else f"a {type(value).__qualname__}, not plain data"
            problems.append(
                f"{type(callback).__name__}'s `{name}`, which has changed in the training, is not saved, as it is {reason}. A "
                f"resumed training begins with it as the callback is given. To save it, define {METHODS}."
            )
    return state | {"has_changed": now != start.attributes}


def _fingerprints(callback: BaseCallback) -> Fingerprints:
    return {name: fingerprint(value) for name, value in vars(callback).items() if name not in COMMON}


def _unsaved(callback: BaseCallback) -> set[str]:
    """Return the names of the attributes that a resumed training gives anew."""
    return {"locals", "globals"}.union(*map(constructor_argument_names, type(callback).__mro__))


def _environments(callback: BaseCallback, training_env: VecEnv) -> dict[str, VecEnv | gym.Env]:
    """Return the environments of a callback by attribute, without the training's own."""
    found = {name: value for name, value in vars(callback).items() if isinstance(value, VecEnv | gym.Env)}
    return {name: value for name, value in found.items() if not is_part_of(value, training_env)}
