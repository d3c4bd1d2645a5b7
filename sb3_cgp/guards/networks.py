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
from stable_baselines3.common.vec_env import DummyVecEnv
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer
from torch.nn.parameter import is_lazy

from sb3_cgp.common.random_state import preserved_random_state
from sb3_cgp.common.rules import require
from sb3_cgp.common.spaces import by_key, sample_of
from sb3_cgp.guards.observations import innermost
from sb3_cgp.guards.scores import check_scores

GOAL_KEYS = ("observation", "achieved_goal", "desired_goal")


def check_observation_space(space: spaces.Space) -> None:
    """
    Refuse scalars, which neither SB3's replay buffer nor its ``CombinedExtractor`` takes, and what SB3 cannot encode.

    :param space: the observation space
    :raises ValueError: naming the space, and the remedy
    """
    for key, subspace in by_key(space).items():
        name = "observation_space" if key is None else f"observation_space['{key}']"
        allowed = "of a shape with at least one axis, such as (1,): return `np.array([value])` from the environment"
        require(not isinstance(subspace, spaces.Box) or subspace.shape != (), name, subspace, allowed)
        if isinstance(subspace, spaces.Discrete | spaces.MultiDiscrete):
            allowed = "with `start` 0, as SB3 encodes numbers from 0: subtract `start` in the environment"
            require(not np.any(subspace.start), name, subspace, allowed)
            allowed = "of one axis, as SB3 encodes no others: flatten the space and the observations"
            require(subspace.shape is not None and len(subspace.shape) <= 1, name, subspace, allowed)


def check_goals(model: OffPolicyAlgorithm) -> None:
    """
    Check that an environment has the goals and the method that hindsight replay (HER) needs.

    :param model: the model, of any class of replay buffers; without an environment, only its observation space is checked
    :raises ValueError: if a key of the observations is missing, or the method ``compute_reward``
    """
    if not (isinstance(model.replay_buffer_class, type) and issubclass(model.replay_buffer_class, HerReplayBuffer)):
        return
    space = model.observation_space
    is_goal_space = isinstance(space, spaces.Dict) and all(key in space.spaces for key in GOAL_KEYS)
    allowed = f"a Dict with the keys {', '.join(repr(key) for key in GOAL_KEYS)} for a HerReplayBuffer"
    require(is_goal_space, "observation_space", space, allowed)
    if model.env is not None:
        allowed = "one with a method `compute_reward(achieved_goal, desired_goal, info)` for a HerReplayBuffer"
        require(model.env.has_attr("compute_reward"), "env", model.env, allowed)
        # An exception in a worker process would end it
        if isinstance(innermost(model.env), DummyVecEnv):
            _try_rewards(model)


def _try_rewards(model: OffPolicyAlgorithm) -> None:
    """Compute the rewards of two goals, as hindsight replay computes those of a batch."""
    assert model.env is not None
    assert isinstance(model.observation_space, spaces.Dict)
    # As replay buffers store them: a `Discrete` goal has an axis more
    shapes = get_obs_shape(model.observation_space)
    assert isinstance(shapes, dict)
    achieved, desired = (np.zeros((2, *shapes[key]), model.observation_space[key].dtype) for key in GOAL_KEYS[1:])
    try:
        rewards = model.env.env_method("compute_reward", achieved, desired, [{}, {}], indices=[0])[0]
        is_batch = np.shape(rewards) in ((2,), (2, 1))
    except TypeError as error:
        if "positional argument" not in str(error):
            return
        rewards, is_batch = f"{type(error).__name__}: {error}", False
    except Exception:
        # It may need more than a new environment has, or entries of `info`
        return
    require(
        is_batch,
        "env.compute_reward",
        rewards,
        "able to return the rewards of a batch: `compute_reward(achieved_goal, desired_goal, info)` is given arrays of B "
        "goals and a list of B infos, and returns an array of shape (B,)",
    )


# Whoever loads a model to act may have switched gradients off
@th.inference_mode(False)
@th.enable_grad()
def try_networks(model: OffPolicyAlgorithm) -> None:
    """
    Pass a batch of random observations through copies of a policy's networks, and back.

    The policy itself, its buffers, and the random generators stay as they are. An algorithm without an actor and critics, and
    a policy that cannot be copied, are not tried.

    :param model: the model, its networks made
    :raises ValueError: if a parameter is not initialised, if a network fails or returns a wrong shape, naming the network and
        the observation space, or if the selector would choose actions by other values than the critic learns
    """
    _check_initialised(model.policy)
    if not (hasattr(model.policy, "actor") and hasattr(model.policy, "critic")):
        return
    try:
        policy: Any = copy.deepcopy(model.policy)
    except Exception:
        # A copy is made for this trial alone: it is no rule that a policy can be copied
        return
    with preserved_random_state(model.device):
        try:
            observations = _try_on(policy, model, is_random=True)
        except ValueError as error:
            # The environment may use a part of its space only, for which the networks are made
            try:
                observations = _try_on(policy, model, is_random=False)
            except ValueError:
                raise error from error.__cause__
        check_scores(policy, model, observations)


def _check_initialised(policy: th.nn.Module) -> None:
    """Refuse parameters of lazy modules, of which each network and its target would make others at their first call."""
    allowed = (
        "initialised when the model is made: give its module the sizes, as in `nn.Linear(n, 8)` for `nn.LazyLinear(8)`, "
        "or pass an observation through the features extractor in its constructor"
    )
    for name, parameter in policy.named_parameters():
        require(not is_lazy(parameter), f"policy.{name}", parameter, allowed)


def _try_on(policy: Any, model: OffPolicyAlgorithm, is_random: bool) -> Any:
    """Try a copied policy on a batch of random observations, or of zeros where the space has them, and return the batch."""
    batch_size = min(model.batch_size, 3)
    observations = _make_observations(model.observation_space, batch_size, model.device, is_random)
    actions = th.zeros(batch_size, get_action_dim(model.action_space), device=model.device)
    with _naming(model, "actor"):
        _try_training(policy.actor, lambda: [policy.actor(observations)], actions.shape)
    with _naming(model, "critic"):
        _try_training(policy.critic, lambda: policy.critic(observations, actions), (batch_size, 1))
    if hasattr(policy, "select_actions"):
        for critic in (policy.critic, policy.critic_target):
            with _naming_selector(), th.no_grad():
                _require_selection(policy.select_actions(observations, critic), actions)
    return observations


def _try_training(network: th.nn.Module, call: Callable[[], Any], shape: tuple[int, ...]) -> None:
    """Let a network act on the batch, as before its first gradient step, and learn from it."""
    network.train(False)
    with th.no_grad():
        call()
    network.train(True)
    outputs = call()
    for output in outputs:
        _require_shape(output, shape)
    # A network that is frozen on purpose has none
    if any(parameter.requires_grad for parameter in network.parameters()):
        sum(output.sum() for output in outputs).backward()


def _require_shape(output: th.Tensor, shape: tuple[int, ...]) -> None:
    if tuple(output.shape) != tuple(shape):
        raise ValueError(f"its output has shape {tuple(output.shape)}, where {tuple(shape)} is expected")


def _require_selection(selection: Any, actions: th.Tensor) -> None:
    """Check a selection against actions of the right shape, type and device."""
    for name in ("actions", "elites"):
        values = getattr(selection, name)
        if not isinstance(values, th.Tensor) or values.dtype != actions.dtype or values.device != actions.device:
            kind = f"{values.dtype} on {values.device}" if isinstance(values, th.Tensor) else f"a {type(values).__name__}"
            raise ValueError(f"its `{name}` are {kind}, where a tensor of {actions.dtype} on {actions.device} is expected")
        if name == "actions":
            _require_shape(values, tuple(actions.shape))
    selected, elites = selection.actions, selection.elites
    if elites.dim() != 3 or (elites.shape[0], elites.shape[2]) != tuple(actions.shape):
        raise ValueError(f"its `elites` have shape {tuple(elites.shape)}, where (B, K, A) is expected")
    if not bool((selected.abs() <= 1.0).all()):
        raise ValueError(f"its `actions` are not within [-1, 1]: {selected.tolist()}")


@contextmanager
def _naming_selector() -> Iterator[None]:
    """Name the selector in an error."""
    try:
        yield
    except Exception as error:
        raise ValueError(
            f"The selector of actions failed for a batch of observations: {type(error).__name__}: {error}. Change "
            "`policy_kwargs['selector']`, an instance with a method `select` that returns a `Selection`, or the policy's "
            "`make_score`."
        ) from error


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


def _near_zero(space: spaces.Space) -> Any:
    """Return an observation of zeros, as far as its bounds allow; a random one of spaces that are no ``Box``."""
    if isinstance(space, spaces.Dict):
        return {key: _near_zero(subspace) for key, subspace in space.items()}
    if isinstance(space, spaces.Box):
        return np.clip(np.zeros(space.shape, space.dtype), space.low, space.high)
    return space.sample()


def _make_observations(space: spaces.Space, batch_size: int, device: th.device, is_random: bool) -> Any:
    """Return observations of the shapes that a replay buffer samples, (B, *shape), by key for ``Dict`` spaces."""
    # A copy, as the space has random numbers of its own
    space = copy.deepcopy(space)
    space.seed(0)
    samples = [sample_of(space) if is_random else _near_zero(space) for _ in range(batch_size)]
    shape = get_obs_shape(space)

    def stack(values: list[Any], each_shape: tuple[int, ...]) -> th.Tensor:
        stacked = th.as_tensor(np.stack(values).reshape(batch_size, *each_shape), device=device)
        # As the replay buffer narrows them, or SB3's preprocessing
        return stacked.float() if stacked.is_floating_point() else stacked

    if isinstance(shape, dict):
        return {key: stack([sample[key] for sample in samples], each) for key, each in shape.items()}
    return stack(samples, shape)
