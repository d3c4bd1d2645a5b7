"""States of other environments, spaces and models are refused."""

import numpy as np
import pytest
from environment_states import PENDULUM, assert_same, make_task, start
from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize

from sb3_cgp.resumption.environments import RestorableEnv, environment_state, restore_environment


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
