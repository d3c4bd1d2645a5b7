"""
The state of a replay buffer: its rows by field, and its counters.

The buffer's class is not part of the state: a state loads into any buffer that has the same fields. A buffer whose rows are
not arrays of its own lists their names in a class attribute, ``row_fields``; each of these attributes is an array or tensor,
shape (buffer_size, n_envs, ...), that can be written to.
"""

from collections.abc import Collection, Iterator
from enum import Enum
from types import FunctionType
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_cgp.common.replay_buffers import is_ours, saves_memory
from sb3_cgp.common.rules import require
from sb3_cgp.common.sb3_arguments import constructor_argument_names
from sb3_cgp.resumption.plain_data import plain_attributes, set_plain_attributes

State = dict[str, Any]
# The types of a buffer's attributes that hold no state; its environment is saved as the model's
CONSTANT_TYPES = (Enum, FunctionType, np.dtype, spaces.Space, th.device, type, VecEnv)
# SB3's fields, none of which refers to a row's position
SB3_FIELDS = {"observations", "next_observations", "actions", "rewards", "dones", "timeouts"}


def replay_buffer_state(buffer: ReplayBuffer) -> State:
    """
    Return the state of a replay buffer.

    :param buffer: the buffer
    :return: plain data; the arrays may be the buffer's own
    """
    # With optimize_memory_usage, the row after the last one holds its next observation
    n_rows = buffer.buffer_size if buffer.full else min(buffer.pos + 1, buffer.buffer_size)
    rows = {path: array[:n_rows] for path, array in _row_arrays(buffer)}
    return {
        "n_envs": buffer.n_envs,
        "optimize_memory_usage": saves_memory(buffer),
        "buffer_size": buffer.buffer_size,
        "rows": {path: array.numpy(force=True) if isinstance(array, th.Tensor) else array for path, array in rows.items()},
        "attributes": plain_attributes(buffer, without={"infos", *_field_names(buffer), *_models_arguments(type(buffer))}),
    }


def fill_replay_buffer(buffer: ReplayBuffer, state: State, changed: Collection[str] = ()) -> None:
    """
    Fill an empty replay buffer with the saved transitions.

    :param buffer: the buffer
    :param state: what :func:`replay_buffer_state` returned
    :param changed: the names of arguments with which this buffer was made in another way, whose attributes are not restored
    :raises ValueError: if the buffer has other fields, another number of environments, or too few rows
    """
    for name, given in {"n_envs": buffer.n_envs, "optimize_memory_usage": saves_memory(buffer)}.items():
        require(given == state[name], f"replay_buffer.{name}", given, f"{state[name]}, as was saved")
    arrays = dict(_row_arrays(buffer))
    missing = sorted(set(state["attributes"]) - set(vars(buffer)))
    same = arrays.keys() == state["rows"].keys() and not missing
    saved = ", ".join([*state["rows"], *missing])
    require(same, "replay_buffer_class", type(buffer).__name__, f"a class with the fields that were saved: {saved}")
    rows, position = _fit(buffer, state)
    converted = {path: _convert(path, values, arrays[path]) for path, values in rows.items()}
    for path, values in converted.items():
        arrays[path][: len(values)] = th.from_numpy(values) if isinstance(arrays[path], th.Tensor) else values
    kept = {name: value for name, value in state["attributes"].items() if name not in changed}
    set_plain_attributes(buffer, kept | position)


def check_savable(buffer: ReplayBuffer) -> None:
    """
    Refuse a replay buffer that cannot be saved.

    :param buffer: the buffer
    :raises ValueError: if the buffer holds the environment's infos, or an attribute that is not plain data
    """
    copies = isinstance(buffer, HerReplayBuffer) and buffer.copy_info_dict
    require(not copies, "copy_info_dict", copies, "False where the training is saved")
    attributes = plain_attributes(buffer, without={"infos", *_field_names(buffer)})
    saved = {*_field_names(buffer), *attributes, "infos"}
    for name, value in vars(buffer).items():
        is_saved = name in saved or isinstance(value, CONSTANT_TYPES) or _is_storage(buffer, value)
        require(is_saved, f"replay_buffer.{name}", value, "plain data or an array where the training is saved")


def _models_arguments(cls: type) -> set[str]:
    """Return the names of the arguments that the model gives anew. Those of a user's own class may change, as a weight's."""
    return set().union(*(constructor_argument_names(base) for base in cls.__mro__ if is_ours(base)))


def _is_storage(buffer: ReplayBuffer, value: Any) -> bool:
    """Return whether an attribute stores the rows of a buffer with ``row_fields``."""
    return hasattr(buffer, "row_fields") and isinstance(value, (th.Tensor, np.ndarray))


def _field_names(buffer: ReplayBuffer) -> set[str]:
    names = {path.partition(".")[0] for path, _ in _row_arrays(buffer)}
    return names | {name for name, value in vars(buffer).items() if _is_storage(buffer, value)}


def _row_arrays(buffer: ReplayBuffer) -> Iterator[tuple[str, Any]]:
    """List a buffer's arrays and tensors of shape (buffer_size, n_envs, ...), by their path."""
    if hasattr(buffer, "row_fields"):
        yield from ((name, getattr(buffer, name)) for name in buffer.row_fields)
        return
    for name, value in vars(buffer).items():
        fields = {f"{name}.{key}": field for key, field in value.items()} if isinstance(value, dict) else {name: value}
        for path, field in fields.items():
            is_array = isinstance(field, th.Tensor) or (isinstance(field, np.ndarray) and field.dtype != object)
            if is_array and field.ndim > 1 and len(field) == buffer.buffer_size:
                yield path, field


def _fit(buffer: ReplayBuffer, state: State) -> tuple[State, State]:
    """Return the saved rows and the counters as a buffer of this size holds them."""
    rows, size = state["rows"], buffer.buffer_size
    position, is_full = state["attributes"]["pos"], state["attributes"]["full"]
    if size == state["buffer_size"]:
        return rows, {}
    arrays = {name: value for name, value in state["attributes"].items() if isinstance(value, np.ndarray)}
    for name, array in arrays.items():
        allowed = f"{buffer.n_envs * state['buffer_size']}, as saved: replay_buffer.{name} is of shape {array.shape}"
        require(array.shape == np.shape(getattr(buffer, name)), "buffer_size", size * buffer.n_envs, allowed)
    n_rows = state["buffer_size"] if is_full else position
    n_envs, given = buffer.n_envs, size * buffer.n_envs
    # The buffers whose rows refer to each other need one more row
    is_free = {path.partition(".")[0] for path in rows} <= SB3_FIELDS and not saves_memory(buffer)
    allowed = f"at least {n_envs * (n_rows + (not is_free))}, as many transitions as were saved"
    require(n_rows + (not is_free) <= size, "buffer_size", given, allowed)
    if is_full:
        same = f"{n_envs * state['buffer_size']}, as saved: the rows of this full replay buffer refer to each other"
        require(is_free, "buffer_size", given, same)
        # The oldest row first
        rows = {path: np.roll(values, -position, axis=0) for path, values in rows.items()}
    return {path: values[:size] for path, values in rows.items()}, {"pos": n_rows % size, "full": n_rows == size}


def _convert(path: str, values: np.ndarray, field: Any) -> np.ndarray:
    """Convert rows to the data type of a buffer's field. Refuse another shape, and a conversion that is not exact."""
    name = f"replay_buffer.{path}"
    dtype = np.asarray(field[:0].numpy(force=True)).dtype if isinstance(field, th.Tensor) else field.dtype
    shape = tuple(field.shape[1:])
    require(shape == values.shape[1:], name, f"of shape (buffer_size, {', '.join(map(str, shape))})", f"of {values.shape}")
    if dtype == values.dtype:
        return values
    with np.errstate(all="ignore"):
        converted = values.astype(dtype)
        is_exact = np.array_equal(converted.astype(values.dtype), values, equal_nan=values.dtype.kind in "fc")
    require(is_exact, name, f"of type {dtype}", f"of type {values.dtype}, as saved: the saved values are not exact in {dtype}")
    return converted
