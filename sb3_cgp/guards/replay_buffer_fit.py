"""Replay buffers that do not fit a model: of other environments, or against its arguments."""

import inspect
from collections.abc import Mapping
from typing import Any

from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.her.goal_selection_strategy import KEY_TO_GOAL_STRATEGY
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_cgp.common.replay_buffers import is_ours, stores_as_given
from sb3_cgp.common.rules import require
from sb3_cgp.common.sb3_arguments import replay_buffer_class_of
from sb3_cgp.common.spaces import have_same_layout
from sb3_cgp.guards.argument_names import check_names

# The arguments of a replay buffer that the algorithm gives
GIVEN_BY_MODEL = {"buffer_size", "observation_space", "action_space", "device", "n_envs", "optimize_memory_usage", "env"}


def fit_replay_buffer(model: OffPolicyAlgorithm) -> None:
    """
    Let a hindsight replay buffer compute rewards by the model's environment, which may have changed.

    :param model: the model
    """
    if isinstance(model.replay_buffer, HerReplayBuffer) and model.env is not None:
        # `HerReplayBuffer.set_env` refuses a second environment
        model.replay_buffer.env = model.env


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


def check_loaded_replay_buffer(buffer: ReplayBuffer, model: OffPolicyAlgorithm) -> None:
    """
    Check that a loaded replay buffer fits a model and its arguments, which the buffer's settings would outrank silently.

    :param buffer: the replay buffer
    :param model: the model
    :raises ValueError: if the buffer contradicts ``replay_buffer_class``, ``n_steps``, ``optimize_memory_usage`` or
        ``replay_buffer_kwargs``, or is of other spaces or of another number of environments
    """
    asked = replay_buffer_class_of(model)
    kinds = [vars(each).get("stands_for", each) for each in (type(buffer), asked)]
    # A class of the user's own may do what the arguments ask for
    fits = kinds[0] is kinds[1] or not all(map(is_ours, kinds))
    allowed = f"a {asked.__name__}, by the model's `replay_buffer_class`, `n_steps` and observation space"
    require(fits, "replay_buffer", type(buffer).__name__, f"{allowed}: load the model with those of the saved one")
    # A class of the user's own may change its arguments along the training
    kwargs = model.replay_buffer_kwargs if is_ours(kinds[0]) else {}
    for name, value in {"optimize_memory_usage": model.optimize_memory_usage, **kwargs}.items():
        stored = getattr(buffer, name, value)
        value = KEY_TO_GOAL_STRATEGY.get(value.lower(), value) if isinstance(value, str) else value
        require(stored == value, f"replay_buffer.{name}", stored, f"{value}, as in the model's arguments")
    check_replay_buffer(buffer, model)


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
