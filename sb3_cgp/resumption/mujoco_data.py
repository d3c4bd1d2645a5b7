"""The state of a MuJoCo simulation, and of its model."""

from collections.abc import Iterator
from typing import Any

import numpy as np

# Fields of a model that are large, and that no step of an environment changes
GEOMETRY = ("bvh", "flex", "mesh", "oct", "skin", "tex")
CONTACT_FLAGS = {"geom_conaffinity", "geom_contype"}


def get_mujoco_data(layer: Any) -> Any:
    """
    Return a MuJoCo environment's data.

    :param layer: an environment or wrapper
    :return: its ``data``, or None if it is not a MuJoCo environment
    """
    data = vars(layer).get("data")
    # By the name of its module, as importing MuJoCo takes long
    return data if data is not None and f"{type(data).__module__}.".startswith("mujoco.") else None


def is_restorable(data: Any) -> bool:
    """
    Return whether the numeric fields of MuJoCo's data are its whole state, as without plugins, flexible bodies and sleep.

    :param data: MuJoCo's data
    :return: whether they are
    """
    import mujoco

    model = data.model
    # The oldest versions of MuJoCo that Gymnasium works with have no sleep and no flexible bodies
    sleep = getattr(mujoco.mjtEnableBit, "mjENBL_SLEEP", 0)
    return not (model.nplugin or getattr(model, "nflex", 0) or model.opt.enableflags & int(sleep))


def is_view(array: np.ndarray, data: Any) -> bool:
    """
    Return whether an array lies in the main buffer of MuJoCo's data, whose first field is ``qpos``.

    :param array: the array
    :param data: MuJoCo's data
    :return: whether it does
    """
    offset = array.__array_interface__["data"][0] - data.qpos.__array_interface__["data"][0]
    return 0 <= offset < data.nbuffer


def mujoco_state(data: Any) -> dict[str, Any]:
    """
    Copy the state of a MuJoCo simulation.

    :param data: MuJoCo's data
    :return: the fields by name
    """
    return {name: field.copy() for name, field in _fields(data)} | {"time": data.time}


def set_mujoco_state(data: Any, state: dict[str, Any]) -> None:
    """
    Restore the state of a MuJoCo simulation.

    :param data: MuJoCo's data, of the same model
    :param state: the state that :func:`mujoco_state` returned
    """
    data.time = state["time"]
    for name, field in _fields(data):
        field[...] = state[name]


def model_state(model: Any) -> dict[str, Any]:
    """
    Copy the parts of a MuJoCo model that environments change, as those do that randomise masses, sizes or places.

    :param model: MuJoCo's model
    :return: the fields by name, those of its options after "opt."
    """
    options = {f"opt.{name}": np.copy(getattr(model.opt, name)) for name in _names(model.opt, "fi")}
    return {name: field.copy() for name, field in _model_fields(model)} | options


def set_model_state(model: Any, state: dict[str, Any]) -> None:
    """
    Restore the parts of a MuJoCo model that environments change.

    :param model: the model, of the same structure
    :param state: the state that :func:`model_state` returned
    """
    for name, field in _model_fields(model):
        field[...] = state[name]
    for name in _names(model.opt, "fi"):
        value = state[f"opt.{name}"]
        setattr(model.opt, name, value if value.ndim else value.item())


def _names(struct: Any, kinds: str) -> list[str]:
    """List the numeric fields of one of MuJoCo's structures."""
    names = [name for name in dir(struct) if not name.startswith("_")]
    return [name for name in names if np.asarray(getattr(struct, name)).dtype.kind in kinds]


def _model_fields(model: Any) -> Iterator[tuple[str, np.ndarray]]:
    """List the fields of a model that may change between its steps, as writable arrays: all numbers, but for geometry."""
    for name in dir(model):
        field = None if name.startswith(("_", *GEOMETRY)) else getattr(model, name)
        if isinstance(field, np.ndarray) and field.size and (field.dtype.kind in "fb" or name in CONTACT_FLAGS):
            yield name, field


def _fields(data: Any) -> Iterator[tuple[str, np.ndarray]]:
    """
    List the fields that MuJoCo steps from and that environments read before the next step, as writable arrays.

    These are all fields of floats and flags in the main buffer, derived fields included.
    Each step computes the indices of the main buffer and the contents of the arena, such as contacts, before it reads them;
    neither is safe to write to.
    """
    for name in dir(data):
        field = None if name.startswith("_") else getattr(data, name)
        if isinstance(field, np.ndarray) and field.size and field.dtype.kind in "fb" and is_view(field, data):
            yield name, field
