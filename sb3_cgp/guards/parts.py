"""Parts of a model that do not fit together: replay buffers and action noise of other environments."""

import copy
import inspect
import io
import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise, VectorizedActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.her.goal_selection_strategy import KEY_TO_GOAL_STRATEGY
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_cgp.common.replay_buffers import stores_as_given
from sb3_cgp.common.rules import require
from sb3_cgp.common.sb3_arguments import replay_buffer_class_of
from sb3_cgp.common.spaces import check_action_space, have_same_layout
from sb3_cgp.guards.contents import check_contents
from sb3_cgp.guards.names import check_names

# The arguments of a replay buffer that the algorithm gives
GIVEN_BY_MODEL = {"buffer_size", "observation_space", "action_space", "device", "n_envs", "optimize_memory_usage", "env"}


class PartsGuard(OffPolicyAlgorithm):
    """An algorithm that adapts action noise to the number of environments, and refuses a replay buffer that does not fit."""

    @classmethod
    def _wrap_env(cls, env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        # SB3's is a static method, which could not call its base class's. It comes before SB3's assertions on the space.
        wrapped = super()._wrap_env(env, verbose, monitor_wrapper)
        check_action_space(wrapped.action_space)
        return wrapped

    def _setup_model(self) -> None:
        allowed = "None or an ActionNoise, such as NormalActionNoise(np.zeros(n), 0.1 * np.ones(n)) for n action dimensions"
        is_noise = self.action_noise is None or isinstance(self.action_noise, ActionNoise)
        require(is_noise, "action_noise", self.action_noise, allowed)
        check_action_noise_shape(self.action_noise, self.action_space)
        check_replay_buffer_kwargs(replay_buffer_class_of(self), self.replay_buffer_kwargs)
        super()._setup_model()

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, Any]:
        allowed = f"an environment: `{type(self).__name__}.load(path, env)`, or `set_env` before `learn`"
        require(self.env is not None, "env", self.env, allowed)
        assert self.env is not None
        self._fit_action_noise(self.env.num_envs)
        check_action_noise_shape(self.action_noise, self.action_space)
        if self.replay_buffer is not None:
            check_replay_buffer(self.replay_buffer, self)
            check_contents(self.replay_buffer)
        result = super()._setup_learn(*args, **kwargs)
        self._fit_replay_buffer()
        return result

    def load_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool = True) -> None:
        """
        Load a replay buffer from a pickle file. If it does not fit the model, the model keeps the buffer that it has.

        :param path: Path to the pickled replay buffer.
        :param truncate_last_traj: When using ``HerReplayBuffer`` with online sampling: whether the last trajectory in the
            replay buffer was finished. With False, it is continued where the environment is still at its end.
        :raises ValueError: if the buffer is of other spaces or of another number of environments than the model
        """
        previous = self.replay_buffer
        super().load_replay_buffer(path, truncate_last_traj)
        assert self.replay_buffer is not None
        try:
            check_replay_buffer(self.replay_buffer, self)
        except ValueError:
            self.replay_buffer = previous
            raise

    def _fit_replay_buffer(self) -> None:
        """Let a hindsight replay buffer compute rewards by the model's environment, which may have changed."""
        if isinstance(self.replay_buffer, HerReplayBuffer) and self.env is not None:
            # `HerReplayBuffer.set_env` refuses a second environment
            self.replay_buffer.env = self.env

    def _fit_action_noise(self, n_envs: int) -> None:
        """Adapt vectorised action noise to the number of environments, which `load` may have changed."""
        noise = self.action_noise
        if not isinstance(noise, VectorizedActionNoise) or len(noise.noises) == n_envs:
            return
        base = copy.deepcopy(noise.base_noise)
        self.action_noise = base if n_envs == 1 else VectorizedActionNoise(base, n_envs)


def check_action_noise_shape(noise: ActionNoise | None, action_space: spaces.Space) -> None:
    """
    Check that action noise can be added to an action.

    :param noise: the exploration noise, if any; noise of another class than SB3's is not checked
    :param action_space: the action space
    :raises ValueError: if the noise is of another shape
    """
    base = noise.base_noise if isinstance(noise, VectorizedActionNoise) else noise
    for name in ("_mu", "_sigma"):
        # SB3 gives no public access to the mean and the standard deviation
        shape = np.shape(getattr(base, name, 0.0))
        allowed = f"noise of the actions' shape, {action_space.shape}, not {shape}"
        require(_broadcasts_to(shape, action_space.shape or ()), "action_noise", noise, allowed)


def check_replay_buffer_kwargs(buffer_class: type[ReplayBuffer], given: Mapping[str, Any]) -> None:
    """
    Check the arguments of a replay buffer before it is made, which a loaded model puts off.

    :param buffer_class: the buffer's class; one that takes any argument is not checked
    :param given: ``replay_buffer_kwargs``
    :raises TypeError: if the class does not take an argument, naming it and the nearest one
    :raises ValueError: if the strategy of hindsight replay is unknown
    """
    parameters = inspect.signature(buffer_class).parameters
    if not any(each.kind is each.VAR_KEYWORD for each in parameters.values()):
        check_names(buffer_class.__name__, given, set(parameters) - GIVEN_BY_MODEL, {})
    strategy = given.get("goal_selection_strategy")
    if isinstance(strategy, str):
        allowed = f"one of {', '.join(map(repr, KEY_TO_GOAL_STRATEGY))}"
        is_known = strategy.lower() in KEY_TO_GOAL_STRATEGY
        require(is_known, "replay_buffer_kwargs['goal_selection_strategy']", strategy, allowed)


def check_replay_buffer(buffer: ReplayBuffer, model: OffPolicyAlgorithm) -> None:
    """
    Check that a replay buffer fits a model.

    :param buffer: the replay buffer; one of a user's own class that stores in its own way is not checked
    :param model: the model, whose number of environments and spaces are compared with the buffer's
    :raises ValueError: if they differ
    """
    if not stores_as_given(type(buffer)):
        return
    name = type(model).__name__
    require(
        buffer.n_envs == model.n_envs,
        "replay_buffer.n_envs",
        buffer.n_envs,
        f"{model.n_envs}, the model's number of environments: load the model with {buffer.n_envs} of them, "
        f"`{name}.load(path, env)`, or begin with an empty replay buffer",
    )
    require(
        have_same_layout(buffer.observation_space, model.observation_space),
        "replay_buffer.observation_space",
        buffer.observation_space,
        f"of the shape and the kind of dtype of the model's, {model.observation_space}: load the buffer that was saved with "
        "the model, or begin with an empty one",
    )
    # Actions are stored scaled to [-1, 1]: those of other bounds mean other actions
    require(
        buffer.action_space == model.action_space,
        "replay_buffer.action_space",
        buffer.action_space,
        f"the model's, {model.action_space}: load the buffer that was saved with the model, or begin with an empty one",
    )


def _broadcasts_to(shape: tuple[int, ...], other: tuple[int, ...]) -> bool:
    """Return whether NumPy broadcasts an array of a shape to another one."""
    try:
        return np.broadcast_shapes(shape, other) == other
    except ValueError:
        return False
