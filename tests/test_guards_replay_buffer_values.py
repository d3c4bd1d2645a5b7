"""Transitions that a user has put into a replay buffer are checked when a training starts."""

import re

import numpy as np
import pytest
import torch as th
from guarded import SMALL, GuardedTD3, located
from gymnasium import spaces
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.env_util import make_vec_env

from sb3_cgp import CGP
from sb3_cgp.fast.device_replay import DeviceReplayBuffer
from sb3_cgp.guards.replay_buffer_values import ROWS, check_contents


def filled(n_envs=1, algorithm=CGP, n=20, **arguments):
    """Return a model whose replay buffer holds valid transitions of each environment."""
    env = make_vec_env("Pendulum-v1", n_envs=n_envs)
    model = algorithm("MlpPolicy", env, **SMALL | dict(learning_starts=0) | arguments)
    for _ in range(n):
        add(model)
    return model


def add(model, observation=0.5, next_observation=0.25, action=1.0, reward=-1.0):
    n = model.n_envs
    observations = [np.full((n, 3), value, np.float32) for value in (observation, next_observation)]
    model.replay_buffer.add(
        *observations, np.full((n, 1), action, np.float32), np.full(n, reward), np.zeros(n), [{} for _ in range(n)]
    )


@pytest.mark.parametrize("algorithm", [CGP, GuardedTD3])
@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (
            dict(action=2.0),
            "replay_buffer.actions[20]` is 2.0, but must be scaled to [-1, 1]: add `model.policy.scale_action",
        ),
        (dict(action=np.nan), "replay_buffer.actions[20]` is nan, but must be scaled"),
        (dict(observation=np.nan), "replay_buffer.observations[20]` is nan, but must be finite: leave out the transition"),
        (dict(next_observation=np.inf), "replay_buffer.next_observations[20]` is inf, but must be finite"),
        (dict(reward=-np.inf), "replay_buffer.rewards[20]` is -inf, but must be finite"),
    ],
)
def test_an_added_transition_that_is_wrong_is_refused_before_the_first_step(wrong, message, n_envs, algorithm):
    model = filled(n_envs, algorithm)
    add(model, **wrong)
    add(model)
    with pytest.raises(ValueError, match=re.escape(message)):
        model.learn(4)
    assert model.num_timesteps == 0


@pytest.mark.parametrize(
    "arguments",
    [dict(), dict(n_steps=3), dict(optimize_memory_usage=True, replay_buffer_kwargs=dict(handle_timeout_termination=False))],
)
def test_added_transitions_that_are_right_are_learnt_from(arguments):
    model = filled(**arguments)
    assert model.learn(4)._n_updates == 4


def test_a_wrong_transition_far_down_in_a_full_buffer_is_found():
    model = filled(n=1, buffer_size=2 * ROWS)
    model.replay_buffer.full = True
    model.replay_buffer.rewards[ROWS + 7] = np.nan
    with pytest.raises(ValueError, match=re.escape(f"replay_buffer.rewards[{ROWS + 7}]` is nan")):
        model.learn(4)


def test_what_lies_beyond_the_contents_is_not_looked_at():
    model = filled()
    model.replay_buffer.rewards[30] = np.nan
    model.learn(4)


def test_observations_of_a_dict_are_named_by_their_key():
    model = CGP("MultiInputPolicy", located(1, goals=True), replay_buffer_class=HerReplayBuffer, **SMALL).learn(20)
    model.replay_buffer.observations["achieved_goal"][3] = np.nan
    with pytest.raises(ValueError, match=re.escape("replay_buffer.observations['achieved_goal'][3]` is nan")):
        model.learn(4)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("actions", 2.0, "actions[4]` is 2.0, but must be scaled"),
        ("rewards", np.nan, "rewards[4]` is nan, but must be finite"),
    ],
)
def test_a_buffer_on_the_models_device_is_checked_too(name, value, message):
    spaces = make_vec_env("Pendulum-v1").observation_space, make_vec_env("Pendulum-v1").action_space
    buffer = DeviceReplayBuffer(20, *spaces, th.device("cpu"))
    for _ in range(9):
        transition = (np.zeros((1, 3), np.float32), np.zeros((1, 3), np.float32), np.zeros((1, 1), np.float32))
        buffer.add(*transition, np.zeros(1), np.zeros(1), [{}])
    check_contents(buffer)
    getattr(buffer, name)[4] = value
    with pytest.raises(ValueError, match=re.escape(message)):
        check_contents(buffer)


def test_the_bounds_of_actions_are_right_in_every_precision():
    for dtype in (np.float16, np.float32, np.float64):
        buffer = ReplayBuffer(4, spaces.Box(-1, 1, (3,)), spaces.Box(-1, 1, (1,), dtype))
        for bound in (-1.0, 1.0):
            buffer.add(np.zeros((1, 3)), np.zeros((1, 3)), np.full((1, 1), bound, dtype), np.zeros(1), np.zeros(1), [{}])
        check_contents(buffer)
        buffer.actions[1] = 1.01
        with pytest.raises(ValueError, match="must be scaled"):
            check_contents(buffer)
