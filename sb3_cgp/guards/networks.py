"""A trial of the networks when a model is made: errors of the first gradient step are raised at construction."""

import copy
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.preprocessing import get_action_dim, get_obs_shape
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_cgp.common.random_state import preserved_random_state
from sb3_cgp.common.rules import require

GOAL_KEYS = ("observation", "achieved_goal", "desired_goal")


class NetworkGuard(OffPolicyAlgorithm):
    """An algorithm that tries its networks on a small batch of random observations when it is made or loaded."""

    def _setup_model(self) -> None:
        check_observation_space(self.observation_space)
        if isinstance(self.replay_buffer_class, type) and issubclass(self.replay_buffer_class, HerReplayBuffer):
            check_goals(self)
        super()._setup_model()
        try_networks(self)


def check_observation_space(space: spaces.Space) -> None:
    """
    Refuse scalars, which neither SB3's replay buffer nor its ``CombinedExtractor`` takes.

    :param space: the observation space
    :raises ValueError: naming the space, and the remedy
    """
    for key, subspace in space.spaces.items() if isinstance(space, spaces.Dict) else [(None, space)]:
        require(
            not isinstance(subspace, spaces.Box) or subspace.shape != (),
            "observation_space" if key is None else f"observation_space['{key}']",
            subspace,
            "of a shape with at least one axis, such as (1,): return `np.array([value])` from the environment",
        )


def check_goals(model: OffPolicyAlgorithm) -> None:
    """
    Check that an environment has the goals and the method that hindsight replay (HER) needs.

    :param model: the model; without an environment, only its observation space is checked
    :raises ValueError: if a key of the observations is missing, or the method ``compute_reward``
    """
    space = model.observation_space
    is_goal_space = isinstance(space, spaces.Dict) and all(key in space.spaces for key in GOAL_KEYS)
    allowed = f"a Dict with the keys {', '.join(repr(key) for key in GOAL_KEYS)} for a HerReplayBuffer"
    require(is_goal_space, "observation_space", space, allowed)
    if model.env is not None:
        allowed = "one with a method `compute_reward(achieved_goal, desired_goal, info)` for a HerReplayBuffer"
        require(model.env.has_attr("compute_reward"), "env", model.env, allowed)


def try_networks(model: OffPolicyAlgorithm) -> None:
    """
    Pass a batch of random observations through copies of a policy's networks, and back.

    The policy itself, its buffers, and the random generators stay as they are. An algorithm without an actor and critics, and
    a policy that cannot be copied, are not tried.

    :param model: the model, its networks made
    :raises ValueError: if a network fails or returns a wrong shape, naming the network and the observation space
    """
    if not (hasattr(model.policy, "actor") and hasattr(model.policy, "critic")):
        return
    try:
        policy: Any = copy.deepcopy(model.policy)
    except Exception:
        # A copy is made for this trial alone: it is no rule that a policy can be copied
        return
    with preserved_random_state(model.device):
        batch_size = min(model.batch_size, 3)
        observations = _random_observations(model.observation_space, batch_size, model.device)
        actions = th.zeros(batch_size, get_action_dim(model.action_space), device=model.device)
        with _naming(model, "actor"):
            _try_training(policy.actor, lambda: [policy.actor(observations)], actions.shape)
        with _naming(model, "critic"):
            _try_training(policy.critic, lambda: policy.critic(observations, actions), (batch_size, 1))
        if hasattr(policy, "select_actions"):
            for critic in (policy.critic, policy.critic_target):
                with _naming(model, "selector"), th.no_grad():
                    _require_shape(policy.select_actions(observations, critic).actions, actions.shape)


def _try_training(network: th.nn.Module, call: Callable[[], Any], shape: tuple[int, ...]) -> None:
    """Let a network act on the batch, as before its first gradient step, and learn from it."""
    network.train(False)
    with th.no_grad():
        call()
    network.train(True)
    outputs = call()
    for output in outputs:
        _require_shape(output, shape)
    sum(output.sum() for output in outputs).backward()


def _require_shape(output: th.Tensor, shape: tuple[int, ...]) -> None:
    if tuple(output.shape) != tuple(shape):
        raise ValueError(f"its output has shape {tuple(output.shape)}, where {tuple(shape)} is expected")


@contextmanager
def _naming(model: OffPolicyAlgorithm, network: str) -> Iterator[None]:
    """Name the network and the observation space in an error."""
    try:
        yield
    except Exception as error:
        arguments = {name: value for name, value in model.policy_kwargs.items() if name != "optimizer_kwargs"}
        raise ValueError(
            f"The {network} cannot learn from a batch of `observation_space`, {model.observation_space}: "
            f"{type(error).__name__}: {error}. Change `policy` or `policy_kwargs` ({arguments}), `batch_size` "
            f"({model.batch_size}), or the environment's observations."
        ) from error


def _random_observations(space: spaces.Space, batch_size: int, device: th.device) -> Any:
    """Return random observations of the shapes that a replay buffer samples, (B, *shape), by key for ``Dict`` spaces."""
    # A copy, as the space has random numbers of its own
    space = copy.deepcopy(space)
    space.seed(0)
    samples = [space.sample() for _ in range(batch_size)]
    shape = get_obs_shape(space)

    def stack(values: list[Any], each_shape: tuple[int, ...]) -> th.Tensor:
        stacked = th.as_tensor(np.stack(values).reshape(batch_size, *each_shape), device=device)
        # As the replay buffer narrows them, or SB3's preprocessing
        return stacked.float() if stacked.is_floating_point() else stacked

    if isinstance(shape, dict):
        return {key: stack([sample[key] for sample in samples], each) for key, each in shape.items()}
    return stack(samples, shape)
