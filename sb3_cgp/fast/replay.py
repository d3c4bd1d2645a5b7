"""Off-policy algorithms that take no more memory for their replay buffer than they need, and the GPU's if it has it."""

import io
import pathlib
import warnings
from typing import Any, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_cgp.fast.device_replay import DeviceReplayBuffer, fits_device, leaves_room

SelfLeanReplayAlgorithm = TypeVar("SelfLeanReplayAlgorithm", bound="LeanReplayAlgorithm")


def float32_space(space: spaces.Space) -> spaces.Space:
    """
    Narrow a space's floating point numbers to float32, which the networks compute in.

    :param space: an observation space
    :return: the same space with float32 where it had more; other types stay as they are
    """
    if isinstance(space, spaces.Dict):
        return spaces.Dict({key: float32_space(subspace) for key, subspace in space.items()})
    if isinstance(space, spaces.Box) and np.issubdtype(space.dtype, np.floating) and space.dtype.itemsize > 4:
        # Bounds beyond float32's are infinite in it
        with np.errstate(over="ignore"):
            return spaces.Box(space.low.astype(np.float32), space.high.astype(np.float32), dtype=np.float32)
    return space


class LeanReplayAlgorithm(OffPolicyAlgorithm):
    """
    SB3's off-policy algorithm, save for its replay buffer, of whichever class it is.

    Observations are stored in float32 at most, as the networks compute in it: half the memory for MuJoCo's float64.
    A model that is loaded to be watched takes no memory for a million transitions. rl_zoo3's ``enjoy`` and
    ``record_video`` see to that themselves, but only for a fixed list of algorithms.
    """

    # An argument of the algorithm's: the buffer lies on the GPU to be of use to them
    cuda_graphs: bool = True
    # Set by `load`, before the model is built
    _replay_buffer_deferred: bool = False

    def _setup_model(self) -> None:
        # SB3 allocates a buffer here that is not ours: one row of it
        buffer_size, self.buffer_size = self.buffer_size, 1
        super()._setup_model()
        self.buffer_size, self.replay_buffer = buffer_size, None
        if not self._replay_buffer_deferred:
            self._ensure_replay_buffer()

    def _ensure_replay_buffer(self) -> ReplayBuffer:
        """
        Allocate the replay buffer if there is none: as SB3 does it, or on the GPU.

        The class is chosen here and not remembered, as a model may be loaded on another device than it was saved from.

        :return: the replay buffer
        """
        if self.replay_buffer is not None:
            return self.replay_buffer
        assert self.replay_buffer_class is not None
        arguments = (self.replay_buffer_class, self.observation_space, self.optimize_memory_usage, self.device)
        buffer_class = self.replay_buffer_class
        if self.cuda_graphs and fits_device(*arguments):
            if leaves_room(self.observation_space, self.buffer_size, self.device):
                buffer_class = DeviceReplayBuffer
            else:
                message = f"A replay buffer of {self.buffer_size} takes over half of {self.device}'s free memory"
                warnings.warn(f"{message}: it is kept on the host.", stacklevel=2)
        self.replay_buffer = self._allocate(buffer_class)
        return self.replay_buffer

    def _allocate(self, buffer_class: type[ReplayBuffer]) -> ReplayBuffer:
        """
        Make an empty replay buffer.

        :param buffer_class: its class
        :return: the replay buffer
        """
        kwargs = self.replay_buffer_kwargs.copy()
        if issubclass(buffer_class, HerReplayBuffer):
            kwargs["env"] = self.env
        return buffer_class(
            self.buffer_size,
            float32_space(self.observation_space),
            self.action_space,
            device=self.device,
            n_envs=self.n_envs,
            optimize_memory_usage=self.optimize_memory_usage,
            **kwargs,
        )

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, Any]:
        self._ensure_replay_buffer()
        return super()._setup_learn(*args, **kwargs)

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
        Load the model from a zip-file, as SB3 does.

        Its replay buffer is None until ``learn`` allocates it or ``load_replay_buffer`` loads one.

        :param path: path to the file (or a file-like) where to load the agent from
        :param env: the new environment to run the loaded model on
            (can be None if you only need prediction from a trained model) has priority over any saved environment
        :param device: Device on which the code should run.
        :param custom_objects: Dictionary of objects to replace upon loading.
        :param print_system_info: Whether to print system info from the saved model and the current system info
        :param force_reset: Force call to ``reset()`` before training to avoid unexpected behavior.
        :param kwargs: arguments to change in the model when loading, such as ``cem_iterations=4``
        :return: new model instance with loaded parameters
        :raises ValueError: if a changed argument is out of its range or contradicts another one
        """
        kwargs["_replay_buffer_deferred"] = True
        return super().load(path, env, device, custom_objects, print_system_info, force_reset, **kwargs)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_replay_buffer_deferred"]
