"""States of other environments, spaces and models are refused, and other arguments named."""

import warnings

import numpy as np
import pytest
from environment_states import PENDULUM, assert_same, environment_state, make_task, start
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv, VecFrameStack, VecNormalize

from sb3_cgp.resumption.environments import RestorableEnv, restore_environment


@pytest.mark.parametrize(
    ("there", "message"),
    [
        (lambda: PENDULUM(1, n_envs=3), r"`env` is '3 x .*DummyVecEnv > .*PendulumEnv', but must be what .* from, '2 x"),
        (lambda: VecNormalize(PENDULUM(1)), "VecNormalize > .*PendulumEnv', but must be what .* from, '2 x [^ ]*DummyVecEnv"),
        (lambda: PENDULUM(1, wrapper_class=RestorableEnv), "RestorableEnv > .*PendulumEnv', but must be"),
        (lambda: make_task("MountainCarContinuous-v0", 1), "MountainCarEnv', but must be .*PendulumEnv'"),
    ],
)
def test_states_of_other_environments_are_refused(there, message):
    there = there()
    before = environment_state(there)
    with pytest.raises(ValueError, match=message):
        restore_environment(there, environment_state(start(PENDULUM(2), 5)))
    assert_same(environment_state(there), before)


def test_states_of_other_spaces_and_models_are_refused():
    one, other = (VecFrameStack(PENDULUM(1), count) for count in (2, 3))
    with pytest.raises(ValueError, match=r"VecFrameStack\.observation_space` is 'Box.*\(9,\).*, but must be .*\(6,\)"):
        restore_environment(other, environment_state(one))
    one, other = make_task("Hopper-v5", 1), make_task("Hopper-v5", 1)
    state = environment_state(one)
    state["envs"][1]["layers"][-1]["mujoco"]["qpos"] = np.zeros(2)
    with pytest.raises(ValueError, match=r"HopperEnv\.qpos` is 'of shape \(6,\)', but must be .*\(2,\)"):
        restore_environment(other, state)


def make_with(n_envs=2, g=10.0, limit=20, clip=10.0, **kwargs):
    env = make_vec_env("Pendulum-v1", n_envs, 1, env_kwargs=dict(g=g, max_episode_steps=limit), **kwargs)
    return VecNormalize(env, clip_obs=clip)


IN_PROCESSES = dict(wrapper_class=RestorableEnv, vec_env_cls=SubprocVecEnv, vec_env_kwargs=dict(start_method="fork"))


@pytest.mark.parametrize("kwargs", [{}, IN_PROCESSES], ids=["one process", "processes"])
def test_other_arguments_of_the_environment_are_named(kwargs):
    original, other = start(make_with(**kwargs), 5), make_with(g=2.0, limit=30, clip=5.0, **kwargs)
    try:
        with pytest.warns(UserWarning, match="made with other arguments") as caught:
            restore_environment(other, environment_state(original))
        (warning,) = caught
        vectorised, pendulum = "stable_baselines3.common.vec_env.vec_normalize.VecNormalize", "pendulum.PendulumEnv.g"
        for difference in (
            f"{vectorised}.clip_obs is 5.0, and was 10.0",
            f"{pendulum} is 2.0, and was 10.0",
            "TimeLimit._max_episode_steps is 30, and was 20",
        ):
            assert str(warning.message).count(difference) == 1
        assert "or that one has changed them, as by a reset" in str(warning.message)
        # The saved ones are restored
        assert other.get_attr("g") == [10.0, 10.0]
        assert other.clip_obs == 10.0
    finally:
        original.close()
        other.close()


def test_what_the_training_has_changed_is_not_taken_for_an_argument():
    original = start(make_with(), 35)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        restore_environment(make_with(), environment_state(original))
