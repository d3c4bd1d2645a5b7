"""States of Gymnasium's tasks: an environment that one is put into goes on as the original does, to the bit."""

from functools import partial

import mujoco
import numpy as np
import pytest
from environment_states import assert_same, check, environment_state, make_task, start

from sb3_cgp.resumption.environments import restore_environment

MUJOCO_TASKS = (
    *("Ant", "HalfCheetah", "Hopper", "Humanoid", "HumanoidStandup", "InvertedDoublePendulum", "InvertedPendulum"),
    *("Pusher", "Reacher", "Swimmer", "Walker2d"),
)
TASKS = ("Pendulum-v1", "MountainCarContinuous-v0", *(f"{task}-v5" for task in MUJOCO_TASKS))


@pytest.mark.filterwarnings("ignore:.*is out of date")
@pytest.mark.parametrize("task", [*TASKS, "Hopper-v4", "Ant-v4"])
def test_tasks_go_on_to_the_bit(task):
    check(partial(make_task, task, n_envs=1), steps=125, then=205)


@pytest.mark.parametrize("task", MUJOCO_TASKS)
def test_all_of_mujocos_state_is_put_back(task):
    original, other = start(make_task(f"{task}-v5", 1, 1), 44), make_task(f"{task}-v5", 2, 1)
    restore_environment(other, environment_state(original))
    ours, theirs = (env.envs[0].unwrapped for env in (other, original))
    signature = mujoco.mjtState.mjSTATE_INTEGRATION
    states = [np.empty(mujoco.mj_stateSize(ours.model, signature)) for _ in range(2)]
    for each, state in zip((ours, theirs), states, strict=True):
        mujoco.mj_getState(each.model, each.data, state, signature)
    assert_same(*states)
    # What tasks read before they step
    for name in (
        "xpos",
        "xipos",
        "cinert",
        "cvel",
        "cfrc_ext",
        "qfrc_actuator",
        "qfrc_constraint",
        "site_xpos",
        "subtree_com",
    ):
        assert_same(getattr(ours.data, name), getattr(theirs.data, name))
    assert np.any(ours.data.xpos)


def test_a_model_that_lets_bodies_sleep_is_not_restorable():
    env = make_task("Reacher-v5", 1)
    assert environment_state(env) is not None
    env.envs[1].unwrapped.model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP
    assert environment_state(env) is None


def test_seeds_and_options_that_wait_for_the_first_reset():
    original, other, without = (make_task("Pendulum-v1", seed) for seed in (8, 9, 8))
    original.set_options(dict(x_init=0.5, y_init=0.1))
    restore_environment(other, environment_state(original))
    expected = original.reset()
    assert_same(other.reset(), expected)
    assert not np.array_equal(without.reset(), expected)


def test_rendering_does_not_matter():
    env = make_task("Pendulum-v1", 1)
    env.reset()
    env.envs[0].render()
    assert environment_state(env) is not None
    # Else pygame goes on to take SIGTERM for an event, in this process and in those that are forked off it
    env.close()
