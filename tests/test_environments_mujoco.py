"""Environments of MuJoCo's bindings, of users and of other packages, go on to the bit without a declaration."""

from collections import deque
from functools import partial
from types import SimpleNamespace

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from environment_states import check, environment_state, obstacles
from environments import Doubles
from gymnasium import spaces
from gymnasium.envs.mujoco.hopper_v5 import HopperEnv
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_cgp.resumption.declarations import METHODS
from sb3_cgp.resumption.environments import RestorableEnv, restore_environment


def make(environment, seed, **kwargs):
    return make_vec_env(environment, 1, seed, **kwargs)


class Randomised(HopperEnv):
    """A user's task of MuJoCo's that draws masses, gravity and a counter of its own in each episode."""

    episodes = 0

    def reset_model(self):
        self.episodes += 1
        self.model.body_mass[1:] = self.np_random.uniform(2.0, 6.0, len(self.model.body_mass) - 1)
        self.model.opt.gravity[2] = self.np_random.uniform(-11.0, -8.0)
        return super().reset_model()

    def step(self, action):
        observation, reward, *rest = super().step(action)
        return observation, reward + self.episodes, *rest


def test_any_environment_of_gymnasiums_mujoco_goes_on_to_the_bit():
    check(partial(make, Randomised, wrapper_class=lambda env: gym.wrappers.TimeLimit(env, 30)), steps=44, then=70)


def test_an_environment_of_gymnasiums_mujoco_that_holds_more_is_refused_by_name():
    env = make(Randomised, 1)
    env.envs[0].unwrapped.planner = object()
    assert "Randomised.planner is <object object" in " ".join(obstacles(env))


class Delayed(HopperEnv):
    """A user's task that takes each action a step later, and has further names of SB3's vectorised environments."""

    def __init__(self, **kwargs):
        self.actions, self.waiting, self.reset_infos = deque([np.zeros(3)], maxlen=2), 0, []
        super().__init__(**kwargs)

    def step(self, action):
        self.actions.append(action)
        self.waiting += 1
        self.reset_infos = [self.waiting]
        observation, reward, *rest = super().step(self.actions.popleft())
        return observation, reward + self.waiting, *rest


def test_attributes_of_a_users_environment_may_have_the_names_of_other_classes():
    check(partial(make, Delayed, wrapper_class=lambda env: gym.wrappers.TimeLimit(env, 30)), steps=44, then=70)
    env = make(Delayed, 1)
    env.envs[0].unwrapped.reset_infos = object()
    assert "Delayed.reset_infos is <object object" in " ".join(obstacles(env))


class Viewing(HopperEnv):
    """A user's task that reads arrays which change with others."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.height, self.limits = self.data.qpos[1:2], self.init_qpos[1:]
        # Neither of these changes with another
        self.one, self.nothing = np.array(self.data.qvel), np.zeros(0)
        self.same = self.one


def with_copies(env):
    task = env.unwrapped
    task.height, task.limits = task.height.copy(), task.limits.copy()
    return env


def test_an_array_that_shares_memory_is_an_obstacle():
    env = make(Viewing, 1)
    height, limits = obstacles(env)
    assert f"Viewing.height shares memory with MuJoCo's data: it has to be a copy, or the class needs {METHODS}." in height
    assert "Viewing.limits shares memory with its init_qpos: it has to be a copy" in limits
    task = with_copies(env.envs[0]).unwrapped
    assert obstacles(env) == []
    # An environment that has just been made may share what this one does not
    again = make(Viewing, 1)
    restore_environment(again, environment_state(env))
    np.testing.assert_array_equal(again.envs[0].unwrapped.limits, task.limits)


def test_an_array_that_shares_memory_in_another_process_is_no_obstacle_to_restoring():
    options = dict(vec_env_cls=SubprocVecEnv, vec_env_kwargs=dict(start_method="fork"))
    saved = make(Viewing, 1, wrapper_class=lambda env: RestorableEnv(with_copies(env)), **options)
    again = make(Viewing, 1, wrapper_class=RestorableEnv, **options)
    try:
        assert len(obstacles(again)) == 2
        restore_environment(again, environment_state(saved))
    finally:
        saved.close()
        again.close()


BOX = """
<mujoco>
  <worldbody>
    <geom type="plane" size="5 5 1"/>
    <body pos="0 0 0.3"><freejoint/><geom name="box" type="box" size="0.1 0.2 0.05" mass="1"/></body>
    <body pos="1 0 1"><joint name="hinge" axis="0 1 0"/><geom type="capsule" size="0.05 0.3" mass="1"/></body>
  </worldbody>
  <actuator><motor joint="hinge" gear="2"/></actuator>
</mujoco>
"""


class Task:
    """A task as dm_control's suite has them: it draws from NumPy's old generator, and changes the model."""

    def __init__(self):
        self._random, self._target = np.random.RandomState(0), 0.0


class ControlEnvironment:
    """Steps as ``dm_control.rl.control.Environment`` does, whose package is not installed here."""

    def __init__(self):
        model = mujoco.MjModel.from_xml_string(BOX)
        pointers = [SimpleNamespace(ptr=each) for each in (model, mujoco.MjData(model))]
        self.physics = SimpleNamespace(model=pointers[0], data=pointers[1])
        self.task, self._step_count, self._reset_next_step = Task(), 0, True

    def reset(self):
        model, data = self.physics.model.ptr, self.physics.data.ptr
        mujoco.mj_resetData(model, data)
        self._step_count, self._reset_next_step = 0, False
        self.task._target = self.task._random.normal()
        model.geom("box").size[:] = self.task._random.uniform(0.05, 0.2, 3)
        data.qpos[3:7] = self.task._random.normal(size=4)
        mujoco.mj_forward(model, data)

    def step(self, action):
        model, data = self.physics.model.ptr, self.physics.data.ptr
        data.ctrl[:] = action
        mujoco.mj_step2(model, data)
        mujoco.mj_step(model, data, 4)
        mujoco.mj_step1(model, data)
        self._step_count += 1


class Shimmy(gym.Env):
    """What shimmy makes of it."""

    observation_space = spaces.Box(-np.inf, np.inf, (15,), np.float64)
    action_space = spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self):
        self._env = ControlEnvironment()

    def observe(self):
        data = self._env.physics.data.ptr
        return np.concatenate([data.qpos, data.qvel])

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if seed is not None:
            self._env.task._random.seed(seed)
        self._env.reset()
        return self.observe(), {}

    def step(self, action):
        self._env.step(action)
        return self.observe(), self._env.task._target, False, self._env._step_count == 40, {}


Shimmy.__module__, Shimmy.__qualname__ = "shimmy.dm_control_compatibility", "DmControlCompatibilityV0"
ControlEnvironment.__module__, ControlEnvironment.__qualname__ = "dm_control.rl.control", "Environment"


def test_tasks_that_step_as_dm_controls_do_go_on_to_the_bit():
    check(partial(make, Shimmy), steps=65, then=70)


def test_tasks_of_dm_control_that_hold_more_are_not_restorable(monkeypatch):
    env = make(Shimmy, 1)
    inner = env.envs[0].unwrapped._env
    assert obstacles(env) == []
    inner.task.planner = object()
    assert "DmControlCompatibilityV0: sb3_cgp.resumption.dm_control.get_state() returned None." in " ".join(obstacles(env))
    del inner.task.planner
    monkeypatch.setattr(ControlEnvironment, "__module__", "dm_control.composer.environment")
    assert environment_state(env) is None


@pytest.mark.parametrize("task", ["cartpole-swingup", "reacher-easy", "cheetah-run", "walker-walk"])
def test_dm_controls_suite_through_shimmy_goes_on_to_the_bit(task):
    pytest.importorskip("dm_control", reason="dm_control is not installed", exc_type=ImportError)
    pytest.importorskip("shimmy")
    check(partial(make_foreign, f"dm_control/{task}-v0"))


@pytest.mark.parametrize("task", ["FetchReach-v4", "FetchPush-v4", "AdroitHandDoor-v1", "HandReach-v3"])
def test_gymnasium_robotics_goes_on_to_the_bit(task):
    pytest.importorskip("gymnasium_robotics", reason="gymnasium-robotics is not installed")
    check(partial(make_foreign, task))


class Compiled(mujoco.MjOption, Doubles):
    """Derives from a class whose constructor, which is not written in Python, does not tell its arguments."""

    def __init__(self, *args, **kwargs):
        mujoco.MjOption.__init__(self, *args, **kwargs)
        self.steps = 0

    def get_training_state(self):
        return self.steps

    def set_training_state(self, state):
        self.steps = state


def test_an_environment_whose_base_does_not_tell_its_arguments_goes_on_to_the_bit():
    check(partial(make, Compiled), steps=13, then=22)


class NoInfos(gym.Wrapper):
    """Drops the infos, which are not saved where they are no plain data."""

    def reset(self, **kwargs):
        return self.env.reset(**kwargs)[0], {}

    def step(self, action):
        return *self.env.step(action)[:4], {}

    def get_training_state(self):
        return ()

    def set_training_state(self, state):
        assert state == ()


def make_foreign(task, seed):
    return make_vec_env(task, 1, seed, wrapper_class=NoInfos)
