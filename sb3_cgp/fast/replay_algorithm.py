"""Off-policy algorithms whose replay buffer takes no more memory than needed, and lies on the GPU where that is faster."""

import io
import pathlib
import warnings
from collections import OrderedDict
from typing import Any, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_cgp.common.replay_buffers import stores_as_given
from sb3_cgp.common.rules import require
from sb3_cgp.common.sb3_arguments import replay_buffer_class_of
from sb3_cgp.common.vec_normalize import normalises
from sb3_cgp.fast.device_replay import DeviceReplayBuffer, fits_device, leaves_room

SelfLeanReplayAlgorithm = TypeVar("SelfLeanReplayAlgorithm", bound="LeanReplayAlgorithm")


def float32_space(space: spaces.Space) -> spaces.Space:
    """
    Return a space whose floating-point numbers are float32, in which the networks compute.

    :param space: an observation space
    :return: the same space with float32 in place of wider floating-point types; other types do not change
    """
    if isinstance(space, spaces.Dict):
        # Gymnasium sorts the keys of a plain dictionary, and networks may depend on their order
        return spaces.Dict(OrderedDict((key, float32_space(subspace)) for key, subspace in space.items()))
    if isinstance(space, spaces.Box) and np.issubdtype(space.dtype, np.floating) and space.dtype.itemsize > 4:
        # Bounds beyond float32's are infinite in it
        with np.errstate(over="ignore"):
            return spaces.Box(space.low.astype(np.float32), space.high.astype(np.float32), dtype=np.float32)
    return space


class LeanReplayAlgorithm(OffPolicyAlgorithm):
    """
    SB3's off-policy algorithm with a lean replay buffer, of any class.

    Observations are stored in float32 at most, as the networks compute in it, which halves the memory for MuJoCo's float64.
    Observations that ``VecNormalize`` normalises are stored as they are: their difference from the mean, which the networks
    see, may be smaller than float32's resolution.

    A loaded model allocates its replay buffer when it learns. rl_zoo3's ``enjoy`` and ``record_video`` avoid the memory of a
    million transitions too, but only for a fixed list of algorithms.
    """

    # An argument of the CUDA-graph algorithm, which also decides where the buffer lies
    cuda_graphs: bool = True
    # Set by `load`, before the model is built
    _defers_replay_buffer: bool = False
    # The space of stored observations for which a buffer was allocated last
    _allocated_for: spaces.Space | None = None

    def _setup_model(self) -> None:
        # SB3 stores its choices in the arguments, where they would outrank the arguments of a later `load`
        given = self.replay_buffer_class, self.replay_buffer_kwargs
        self.replay_buffer_kwargs = dict(self.replay_buffer_kwargs)
        # One that was saved within the model, or that a subclass has made
        buffer = self.replay_buffer
        # SB3 allocates a buffer unless there is one, and asks for an environment to do so for hindsight replay
        self.replay_buffer = ReplayBuffer.__new__(ReplayBuffer)
        try:
            super()._setup_model()
        finally:
            self.replay_buffer = buffer
            self.replay_buffer_class, self.replay_buffer_kwargs = given
        if buffer is not None:
            # As SB3 does with a loaded one
            buffer.device = self.device
        elif not self._defers_replay_buffer:
            self._ensure_replay_buffer()

    def _ensure_replay_buffer(self) -> ReplayBuffer:
        """Return the replay buffer, allocated now if there is none."""
        if self.replay_buffer is None:
            self.replay_buffer = self._allocate(self._choose_buffer_class())
        return self.replay_buffer

    def _choose_buffer_class(self) -> type[ReplayBuffer]:
        """Return the class of the buffer. A model may be loaded on another device, so that the choice is not stored."""
        buffer_class = replay_buffer_class_of(self)
        choice = (buffer_class, self.observation_space, self.optimize_memory_usage, self.device)
        if not self.cuda_graphs or not fits_device(*choice):
            return buffer_class
        if leaves_room(self._stored_space(), self.buffer_size, self.device):
            return DeviceReplayBuffer
        message = f"A replay buffer of {self.buffer_size} takes over half of {self.device}'s free memory"
        warnings.warn(f"{message}: it is kept on the host.", stacklevel=2)
        return buffer_class

    def _allocate(self, buffer_class: type[ReplayBuffer]) -> ReplayBuffer:
        """Return an empty replay buffer of a class."""
        kwargs = self.replay_buffer_kwargs.copy()
        if issubclass(buffer_class, HerReplayBuffer):
            kwargs["env"] = self.env
        if self._chooses_n_step_returns(buffer_class):
            kwargs |= {"n_steps": self.n_steps, "gamma": self.gamma}
        self._allocated_for = self._stored_space()
        return buffer_class(
            self.buffer_size,
            self._allocated_for,
            self.action_space,
            device=self.device,
            n_envs=self.n_envs,
            optimize_memory_usage=self.optimize_memory_usage,
            **kwargs,
        )

    def _stored_space(self) -> spaces.Space:
        """Return the observation space with the data types in which observations are stored."""
        return self.observation_space if normalises(self._vec_normalize_env) else float32_space(self.observation_space)

    def _chooses_n_step_returns(self, buffer_class: type[ReplayBuffer]) -> bool:
        """Return whether the model's ``n_steps`` and ``gamma`` are the buffer's, as where the user gave no class."""
        return self.replay_buffer_class is None and issubclass(buffer_class, NStepReplayBuffer)

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, Any]:
        buffer, space = self.replay_buffer, self._stored_space()
        # `set_env` may have added or removed VecNormalize since
        if buffer is not None and buffer.observation_space != space:
            if buffer.size() == 0 and buffer.observation_space == self._allocated_for:
                self.replay_buffer = None
            elif normalises(self._vec_normalize_env) and stores_as_given(type(buffer)):
                message = "The replay buffer stores observations in float32, and `env` normalises them now: those near their"
                warnings.warn(f"{message} mean may lose their differences. Train a new model to keep these.", stacklevel=2)
        self._ensure_replay_buffer()
        self._set_n_step_returns()
        return super()._setup_learn(*args, **kwargs)

    def _set_n_step_returns(self) -> None:
        """Give the model's ``n_steps`` and ``gamma`` to the buffer; a loaded one has those of the model that saved it."""
        buffer = self.replay_buffer
        if isinstance(buffer, NStepReplayBuffer) and self._chooses_n_step_returns(type(buffer)):
            buffer.n_steps, buffer.gamma = self.n_steps, self.gamma

    def train(self, *args: Any, **kwargs: Any) -> None:
        """
        Do gradient steps, see the algorithm's method.

        :param args: the algorithm's own arguments
        :param kwargs: the algorithm's own arguments
        :raises ValueError: if there is no data
        """
        n_filled = 0 if self.replay_buffer is None else self.replay_buffer.size()
        require(n_filled > 0, "replay_buffer.size()", n_filled, "above 0: fill it by `learn` or `load_replay_buffer`")
        # A callback may have changed them
        self._set_n_step_returns()
        super().train(*args, **kwargs)

    def save_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase) -> None:
        """
        Save the replay buffer as a pickle file.

        :param path: Path to the file where the replay buffer should be saved.
            if path is a str or pathlib.Path, the path is automatically created if necessary.
        """
        self._ensure_replay_buffer()
        super().save_replay_buffer(path)

    @classmethod
    def load(
        cls: type[SelfLeanReplayAlgorithm],
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> SelfLeanReplayAlgorithm:
        """
        Load the model from a zip-file, as SB3 does, without a replay buffer until ``learn`` allocates it.

        The parameters are those of SB3's ``load``.

        :return: new model instance with loaded parameters
        """
        kwargs["_defers_replay_buffer"] = True
        return super().load(path, env, device, custom_objects, print_system_info, force_reset, **kwargs)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_defers_replay_buffer", "_allocated_for"]
