"""How the environment of a resumed training differs from the saved one, by the states of both."""

import warnings
from typing import Any

import numpy as np

from sb3_cgp.common.rules import require
from sb3_cgp.resumption.plain_data import equal


def _describe(state: dict[str, Any]) -> str:
    """Name the classes of an environment and its wrappers, from the outermost to the innermost."""
    vectorized, *chains = [" > ".join(layer["class"] for layer in each["layers"]) for each in (state, *state["envs"])]
    # The environments are usually all of the same classes
    inside = " | ".join(dict.fromkeys(chains)) if len(set(chains)) == 1 else " | ".join(chains)
    return f"{state['num_envs']} x {' > '.join(each for each in (vectorized, inside) if each)}"


def _all_layers(state: dict[str, Any]) -> list[dict[str, Any]]:
    """List the states of all layers, of the vectorised environment first."""
    return [layer for each in (state, *state["envs"]) for layer in each["layers"]]


def warn_of_other_arguments(current: dict[str, Any], saved: dict[str, Any]) -> None:
    """
    Warn of arguments of an environment and its wrappers that differ from the saved ones, which may have changed since.

    :param current: the state of the environment that is about to be changed
    :param saved: the state that is to be restored
    """
    found = []
    for ours, theirs in zip(_all_layers(current), _all_layers(saved), strict=True):
        for name in ours["arguments"]:
            our, their = (layer["attributes"].get(name) for layer in (ours, theirs))
            if name in theirs["attributes"] and not equal(our, their):
                found.append(f"{ours['class']}.{name} is {our!r}, and was {their!r}")
    if found:
        warnings.warn(
            "The environment was made with other arguments than the saved one, or that one has changed them, as by a reset: "
            f"{'; '.join(dict.fromkeys(found))}. The saved values are restored, as they are part of the training's state. To "
            "go on with others, set them in a callback.",
            stacklevel=4,
        )


def require_same(current: dict[str, Any], saved: dict[str, Any]) -> None:
    """
    Refuse the state of an environment whose classes, spaces or MuJoCo model differ.

    :param current: the state of the environment that is about to be changed
    :param saved: the state that is to be restored
    :raises ValueError: naming what differs
    """
    origin = "what the state was saved from"
    require(_describe(current) == _describe(saved), "env", _describe(current), f"{origin}, {_describe(saved)!r}")
    for ours, theirs in zip(_all_layers(current), _all_layers(saved), strict=True):
        for part, describe in (
            ("spaces", lambda state: state["space"]),
            ("mujoco", lambda field: f"of shape {np.shape(field)}"),
            ("mujoco_model", lambda field: f"of shape {np.shape(field)}"),
        ):
            our, their = ({name: describe(each) for name, each in layer.get(part, {}).items()} for layer in (ours, theirs))
            for name in sorted(our.keys() | their.keys()):
                allowed = f"{origin}, {their.get(name)!r}"
                require(our.get(name) == their.get(name), f"{ours['class']}.{name}", our.get(name), allowed)
