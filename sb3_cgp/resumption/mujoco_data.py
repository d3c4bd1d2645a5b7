"""The state of a MuJoCo simulation."""

from collections.abc import Iterator
from typing import Any

import numpy as np


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
    """
    import mujoco

    model = data.model
    # The oldest versions of MuJoCo that Gymnasium works with have no sleep and no flexible bodies
    sleep = getattr(mujoco.mjtEnableBit, "mjENBL_SLEEP", 0)
    return not (model.nplugin or getattr(model, "nflex", 0) or model.opt.enableflags & int(sleep))


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


def _fields(data: Any) -> Iterator[tuple[str, np.ndarray]]:
    """
    List the fields that MuJoCo steps from and that environments read before the next step, as writable arrays.

    These are all fields of floats and flags in the main buffer, whose first field is ``qpos``, derived fields included.
    Each step computes the indices of the main buffer and the contents of the arena, such as contacts, before it reads them;
    neither is safe to write to.
    """
    start = data.qpos.__array_interface__["data"][0]
    for name in dir(data):
        field = None if name.startswith("_") else getattr(data, name)
        if isinstance(field, np.ndarray) and field.size and field.dtype.kind in "fb":
            offset = field.__array_interface__["data"][0] - start
            if 0 <= offset < data.nbuffer:
                yield name, field
