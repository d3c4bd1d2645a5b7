"""The state of a task of dm_control's suite that shimmy's ``DmControlCompatibilityV0`` wraps."""

from typing import Any

import numpy as np

from sb3_cgp.resumption.declarations import full_name
from sb3_cgp.resumption.mujoco_data import is_restorable, model_state, mujoco_state, set_model_state, set_mujoco_state
from sb3_cgp.resumption.plain_data import plain_attributes, set_plain_attributes

# Those of `dm_control.rl.control.Environment` that change
EPISODE = ("_step_count", "_reset_next_step")
# The task's random generator, which is NumPy's old one
SAVED_APART = {"_random"}


def get_state(env: Any) -> dict[str, Any] | None:
    """
    Copy the state of a task.

    :param env: shimmy's environment
    :return: plain data; None for a task of ``dm_control.composer``, of other attributes than plain data, or of a model whose
        state is more than MuJoCo's numeric fields
    """
    inner = env._env
    # By its full name, as importing dm_control takes long
    if full_name(type(inner)) != "dm_control.rl.control.Environment" or not is_restorable(inner.physics.data.ptr):
        return None
    task = plain_attributes(inner.task, SAVED_APART)
    if vars(inner.task).keys() - task.keys() - SAVED_APART:
        return None
    return {
        "episode": {name: getattr(inner, name) for name in EPISODE},
        "task": task,
        "random": _random_state(inner.task._random),
        "data": mujoco_state(inner.physics.data.ptr),
        "model": model_state(inner.physics.model.ptr),
    }


def set_state(env: Any, state: dict[str, Any]) -> None:
    """
    Restore the state of a task.

    :param env: shimmy's environment, of the same task
    :param state: the state that :func:`get_state` returned
    """
    import mujoco

    inner = env._env
    for name, value in state["episode"].items():
        setattr(inner, name, value)
    set_plain_attributes(inner.task, state["task"])
    inner.task._random.set_state({"bit_generator": "MT19937", **state["random"]})
    model, data = inner.physics.model.ptr, inner.physics.data.ptr
    set_model_state(model, state["model"])
    set_mujoco_state(data, state["data"])
    # dm_control's steps begin with `mj_step2`, which reads contacts and constraints that this function computes
    mujoco.mj_step1(model, data)
    set_mujoco_state(data, state["data"])


def _random_state(random: np.random.RandomState) -> dict[str, Any]:
    """Return the state of an old random generator of NumPy's as plain data."""
    state = dict(random.get_state(legacy=False))
    state.pop("bit_generator")
    return state
