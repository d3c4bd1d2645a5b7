"""A replay buffer on the networks' device: a gradient step then copies nothing but row numbers from the host."""

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import BaseBuffer, ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_cgp.common.rules import require
from sb3_cgp.fast.cuda_graphs import has_cuda_graphs


def fits_device(
    buffer_class: type[ReplayBuffer], observation_space: spaces.Space, optimize_memory_usage: bool, device: th.device
) -> bool:
    """
    Return whether a :class:`DeviceReplayBuffer` can replace a replay buffer.

    :param buffer_class: the model's replay buffer class; SB3 has a class of its own for n-step returns
    :param observation_space: observation space
    :param optimize_memory_usage: whether the buffer is to be SB3's memory efficient variant
    :param device: the model's device
    :return: True for SB3's default class with ``Box`` observations on a GPU that has CUDA graphs
    """
    is_plain = buffer_class is ReplayBuffer and isinstance(observation_space, spaces.Box) and not optimize_memory_usage
    return is_plain and has_cuda_graphs(device)


def leaves_room(observation_space: spaces.Space, buffer_size: int, device: th.device) -> bool:
    """
    Return whether a :class:`DeviceReplayBuffer` leaves enough of the GPU's memory free.

    :param observation_space: observation space, a ``Box``, with the data type in which observations are stored
    :param buffer_size: number of transitions
    :param device: a GPU
    :return: whether its observations, by far the largest part, take at most half of the free memory
    """
    assert isinstance(observation_space, spaces.Box)
    needed = 2 * buffer_size * int(np.prod(observation_space.shape)) * observation_space.dtype.itemsize
    free, _ = th.cuda.mem_get_info(device)
    return needed <= free / 2


def _stored(name: str) -> Any:
    """Return a property for one field of all rows, a tensor that shares the storage."""
    return property(lambda self: self._view(self._rows, name))


class DeviceReplayBuffer(ReplayBuffer):
    """
    SB3's replay buffer for ``Box`` observations, stored on ``device``: the same transitions for the same NumPy seed.

    ``observations``, ``next_observations``, ``actions``, ``rewards``, ``dones`` and ``timeouts`` are tensors of SB3's
    shapes. Assigning to ``device`` moves them. A pickle holds NumPy arrays, and loads where there is no such device.

    :param buffer_size: Max number of element in the buffer
    :param observation_space: Observation space
    :param action_space: Action space
    :param device: PyTorch device
    :param n_envs: Number of parallel environments
    :param optimize_memory_usage: must be False, as this buffer has no memory efficient variant
    :param handle_timeout_termination: Handle timeout termination (due to timelimit)
        separately and treat the task as infinite horizon task.
    :raises ValueError: if ``optimize_memory_usage`` is set or the observation space is not a ``Box``
    """

    # The class in whose place a model has this one
    stands_for = ReplayBuffer
    # The fields that a training state holds
    row_fields = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
    observations = _stored("observations")
    next_observations = _stored("next_observations")
    actions = _stored("actions")
    rewards = _stored("rewards")
    dones = _stored("dones")
    timeouts = _stored("timeouts")

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        handle_timeout_termination: bool = True,
    ):
        is_box = isinstance(observation_space, spaces.Box)
        require(is_box, "observation_space", observation_space, "a Box for a DeviceReplayBuffer")
        allowed = "False for a DeviceReplayBuffer"
        require(not optimize_memory_usage, "optimize_memory_usage", optimize_memory_usage, allowed)
        # SB3 assigns `device` in the constructor below, which moves this tensor
        self._rows = th.empty(0)
        # ReplayBuffer's constructor would allocate the arrays on the host
        BaseBuffer.__init__(self, buffer_size, observation_space, action_space, device, n_envs)
        self.buffer_size = max(buffer_size // n_envs, 1)
        self.optimize_memory_usage = False
        self.handle_timeout_termination = handle_timeout_termination
        # A transition is one row of bytes, so that storing or sampling it is one copy
        self._row_dtype = np.dtype(
            [
                ("observations", observation_space.dtype, self.obs_shape),
                ("next_observations", observation_space.dtype, self.obs_shape),
                ("actions", self._maybe_cast_dtype(action_space.dtype), (self.action_dim,)),
                ("rewards", np.float32),
                ("dones", np.float32),
                ("timeouts", np.float32),
            ],
            align=True,
        )
        shape = (self.buffer_size, n_envs, self._row_dtype.itemsize)
        self._rows = th.zeros(shape, dtype=th.uint8, device=self.device)

    @property
    def device(self) -> th.device:
        """The device that the transitions are stored and sampled on."""
        return self._rows.device

    @device.setter
    def device(self, device: th.device | str) -> None:
        self._rows = self._rows.to(device)

    def _view(self, rows: th.Tensor, name: str) -> th.Tensor:
        """
        Return one field of rows.

        :param rows: transitions as bytes (..., bytes of a row)
        :param name: the field's name
        :return: the field's values (..., *shape of the field), a view
        """
        assert self._row_dtype.fields is not None
        dtype, offset = self._row_dtype.fields[name][:2]
        values = rows[..., offset : offset + dtype.itemsize].view(th.from_numpy(np.empty(0, dtype.base)).dtype)
        return values.view(*rows.shape[:-1], *dtype.shape)

    def add(
        self,
        obs: np.ndarray,
        next_obs: np.ndarray,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """
        Store a transition of every environment.

        :param obs: observations (n_envs, *observation shape)
        :param next_obs: next observations (n_envs, *observation shape)
        :param action: actions (n_envs, *action shape)
        :param reward: rewards (n_envs,)
        :param done: whether the episodes ended (n_envs,)
        :param infos: the environments' information, with the key ``TimeLimit.truncated`` at a timeout
        """
        row = np.zeros(self.n_envs, self._row_dtype)
        row["observations"] = obs
        row["next_observations"] = next_obs
        row["actions"] = action.reshape(self.n_envs, self.action_dim)
        row["rewards"] = reward
        row["dones"] = done
        if self.handle_timeout_termination:
            row["timeouts"] = [info.get("TimeLimit.truncated", False) for info in infos]
        # The call returns when pageable memory has been read, and does not synchronise with earlier work
        self._rows[self.pos].copy_(th.from_numpy(row.view(np.uint8).reshape(self.n_envs, -1)), non_blocking=True)
        self.pos += 1
        if self.pos == self.buffer_size:
            self.full = True
            self.pos = 0

    def _get_samples(self, batch_inds: np.ndarray, env: VecNormalize | None = None) -> ReplayBufferSamples:
        # The same random numbers as SB3's buffer
        env_indices = np.random.randint(0, high=self.n_envs, size=(len(batch_inds),))  # noqa: NPY002
        indices = np.ravel_multi_index((batch_inds, env_indices), (self.buffer_size, self.n_envs))
        rows = self._rows.flatten(0, 1)[th.from_numpy(indices).to(self.device, non_blocking=True)]
        # In the memory layout of SB3's samples, as products may be rounded differently in another layout
        observations = self._view(rows, "observations").contiguous()
        next_observations = self._view(rows, "next_observations").contiguous()
        actions = self._view(rows, "actions").contiguous()
        # Only use dones that are not due to timeouts
        dones = (self._view(rows, "dones") * (1 - self._view(rows, "timeouts"))).reshape(-1, 1)
        rewards = self._view(rows, "rewards").reshape(-1, 1).contiguous()
        if env is not None:
            # VecNormalize computes on the host
            observations, next_observations = (
                self.to_torch(np.asarray(self._normalize_obs(values.numpy(force=True), env)))
                for values in (observations, next_observations)
            )
            rewards = self.to_torch(self._normalize_reward(rewards.numpy(force=True), env))
        return ReplayBufferSamples(observations, actions, next_observations, dones, rewards)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_rows": self._rows.numpy(force=True), "device": self.device}

    def __setstate__(self, state: dict[str, Any]) -> None:
        device = state.pop("device")
        self.__dict__.update(state, _rows=th.from_numpy(state["_rows"]))
        # A model that loads the buffer sets its own device afterwards
        if device.type != "cuda" or device.index < th.cuda.device_count():
            self.device = device
