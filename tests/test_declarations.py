"""Environments of others that are declared restorable go on to the bit, in this process and in others."""

import threading
from collections import deque
from functools import partial
from types import SimpleNamespace

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from environment_states import assert_same as assert_same_values
from environment_states import check, environment_state, go_on, obstacles, start
from environments import Doubles
from gymnasium import spaces
from gymnasium.envs.classic_control import PendulumEnv
from gymnasium.envs.mujoco.hopper_v5 import HopperEnv
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv
from trainings import Training, assert_same, fingerprint

from sb3_cgp import RestorableEnv, register_restorable
from sb3_cgp.resumption import declarations
from sb3_cgp.resumption.declarations import METHODS
from sb3_cgp.resumption.environments import restore_environment


class Foreign(Doubles):
    """A class of somebody else's: its state is in an object, and in no plain attribute alone."""

    def __init__(self):
        self.simulator = SimpleNamespace(position=0.0)

    def step(self, action):
        self.simulator.position += float(action.sum())
        observation, reward, *rest = super().step(action)
        return observation, reward + self.simulator.position, *rest


class Derived(Foreign):
    """A subclass that says nothing of its own."""


class Takes(Foreign):
    """A subclass with the two methods."""

    def get_training_state(self):
        return get_position(self)

    def set_training_state(self, state):
        set_position(self, state)


class Plain(Doubles):
    """A class whose attributes are its state."""

    def __init__(self):
        self.total = [0.0]

    def step(self, action):
        self.total[0] += float(action.sum())
        observation, _, *rest = super().step(action)
        return observation, self.total[0], *rest


def get_position(env):
    return {"position": env.simulator.position, "steps": getattr(env, "steps", None)}


def set_position(env, state):
    env.simulator.position, env.steps = state["position"], state["steps"]


@pytest.fixture(autouse=True)
def _no_declarations(monkeypatch):
    """Forget what a test declares."""
    monkeypatch.setattr(declarations, "_declared", {})


def make(environment, seed, n_envs=2, **kwargs):
    return make_vec_env(environment, n_envs, seed, **kwargs)


@pytest.mark.parametrize("environment", [Foreign, Derived])
@pytest.mark.parametrize("wrapper_class", [None, lambda env: gym.wrappers.TimeLimit(gym.wrappers.ClipAction(env), 4)])
def test_a_declared_class_and_its_subclasses_go_on_to_the_bit(environment, wrapper_class):
    make_wrapped = partial(make, environment, wrapper_class=wrapper_class)
    assert "is unknown and has no get_training_state(): it needs" in " ".join(obstacles(make_wrapped(1)))
    assert "sb3_cgp.register_restorable" in " ".join(obstacles(make_wrapped(1)))
    register_restorable(Foreign, get_position, set_position)
    check(make_wrapped, steps=13, then=22)


def test_a_class_that_is_declared_by_its_attributes_goes_on_to_the_bit():
    register_restorable(Plain)
    check(partial(make, Plain), steps=13, then=22)
    register_restorable(Foreign)
    assert "Foreign.simulator is namespace(position=0.0), which is not plain data" in " ".join(obstacles(make(Foreign, 1)))


def test_a_declared_wrapper_goes_on_to_the_bit():
    class Sum(gym.Wrapper):
        def __init__(self, env):
            super().__init__(env)
            self.sums = SimpleNamespace(reward=0.0)

        def step(self, action):
            observation, reward, *rest = self.env.step(action)
            self.sums.reward += float(reward)
            return observation, self.sums.reward, *rest

    register_restorable(Sum, lambda env: env.sums.reward, lambda env, state: setattr(env.sums, "reward", state))
    check(partial(make, "Pendulum-v1", wrapper_class=Sum), steps=13, then=22)


def test_the_nearest_class_decides():
    called = []
    register_restorable(Foreign, lambda env: called.append("Foreign") or get_position(env), set_position)
    for environment, expected in ((Foreign, "Foreign"), (Derived, "Foreign"), (Takes, None)):
        called.clear()
        assert environment_state(make(environment, 1, n_envs=1)) is not None
        assert called == ([] if expected is None else [expected])
    register_restorable(Derived, lambda env: called.append("Derived") or get_position(env), set_position)
    register_restorable(Takes, lambda env: called.append("Takes") or get_position(env), set_position)
    for environment in (Derived, Takes):
        called.clear()
        environment_state(make(environment, 1, n_envs=1))
        assert called == [environment.__name__]


def test_what_a_function_returns_is_checked():
    register_restorable(Foreign, lambda env: None, set_position)
    reason = " ".join(obstacles(make(Foreign, 1)))
    assert reason.endswith("Foreign: the function `get` that register_restorable was given returned None.")
    register_restorable(Foreign, lambda env: env.simulator, set_position)
    with pytest.raises(ValueError, match=r"Foreign: the function `get` .* returned namespace.* must return plain data"):
        environment_state(make(Foreign, 1))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("Foreign", get_position, set_position), "`cls` is 'Foreign', but must be a class of environments or wrappers"),
        ((make, get_position, set_position), "`cls` is <function make"),
        ((Foreign, "get", set_position), "`get` is 'get', but must be a function"),
        ((Foreign, get_position, 1), "`set` is 1, but must be a function"),
        ((Foreign, get_position), "`set` is None, but must be a function where `get` is one"),
        ((Foreign, None, set_position), "`set` is <function set_position.* and None where `get` is None"),
    ],
)
def test_what_cannot_be_declared_is_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        register_restorable(*arguments)
    assert declarations.find_declaration(Foreign) is None


def test_a_training_on_a_declared_environment_resumes_to_the_bit(tmp_path):
    register_restorable(Foreign, get_position, set_position)
    results = []
    for name, stops in (("straight", ()), ("stopped", (33,))):
        training = Training(tmp_path / name, env=Foreign, steps=50, eval_freq=30)
        results.append(fingerprint(training, training.run(*stops)))
    assert_same(*results)


# Other processes


@pytest.mark.parametrize("start_method", ["fork", "forkserver"])
def test_declarations_reach_processes_that_were_started_before(start_method):
    class Local(Foreign):
        """A class that a worker gets by its code, as it does a class of a script."""

    subprocesses = dict(vec_env_cls=SubprocVecEnv, vec_env_kwargs=dict(start_method=start_method))
    env = make(Local, 1, n_envs=1, wrapper_class=RestorableEnv, **subprocesses)
    try:
        assert "Local is unknown and has no get_training_state()" in " ".join(obstacles(env))
        register_restorable(Local, lambda env: get_position(env), lambda env, state: set_position(env, state))
        state = environment_state(start(env, 7))
        expected = go_on(env, 12)
        restore_environment(env, state)
        assert_same_values(go_on(env, 12), expected)
    finally:
        env.close()


def test_what_cannot_be_sent_to_a_process_is_named():
    lock = threading.Lock()
    register_restorable(Foreign, lambda env: lock and get_position(env), set_position)
    env = make(
        Foreign, 1, n_envs=1, wrapper_class=RestorableEnv, vec_env_cls=SubprocVecEnv, vec_env_kwargs=dict(start_method="fork")
    )
    try:
        assert "What Foreign was declared with cannot be sent to a process" in " ".join(obstacles(env))
        declarations._declared.clear()
        register_restorable(Foreign, lambda env: 1 / 0, set_position)
        assert obstacles(env) == ["ZeroDivisionError: division by zero"]
        env.reset()
    finally:
        env.close()


@pytest.mark.parametrize("is_declared", [True, False])
def test_the_remedy_for_a_declared_environment_without_restorable_env_is_this_wrapper(is_declared):
    gym.register("Foreign-v0", entry_point=f"{__name__}:Foreign")
    if is_declared:
        register_restorable(Foreign, get_position, set_position)
    try:
        env = make("Foreign-v0", 1, n_envs=1, vec_env_cls=SubprocVecEnv, vec_env_kwargs=dict(start_method="fork"))
        reason = " ".join(obstacles(env))
        env.close()
    finally:
        gym.registry.pop("Foreign-v0", None)
    assert ("Make sb3_cgp.resumption.RestorableEnv its outermost wrapper." in reason) == is_declared
    assert ("RestorableEnv alone would not help" in reason) != is_declared


# Ready ones


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
    check(partial(make, Randomised, n_envs=1, wrapper_class=lambda env: gym.wrappers.TimeLimit(env, 30)), steps=44, then=70)


def test_an_environment_of_gymnasiums_mujoco_that_holds_more_is_refused_by_name():
    env = make(Randomised, 1, n_envs=1)
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
    check(partial(make, Delayed, n_envs=1, wrapper_class=lambda env: gym.wrappers.TimeLimit(env, 30)), steps=44, then=70)
    env = make(Delayed, 1, n_envs=1)
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


def test_an_array_that_shares_memory_is_an_obstacle():
    env = make(Viewing, 1, n_envs=1)
    height, limits = obstacles(env)
    assert f"Viewing.height shares memory with MuJoCo's data: it has to be a copy, or the class needs {METHODS}." in height
    assert "Viewing.limits shares memory with its init_qpos: it has to be a copy" in limits
    task = env.envs[0].unwrapped
    task.height, task.limits = task.height.copy(), task.limits.copy()
    assert obstacles(env) == []
    # An environment that has just been made may share what this one does not
    again = make(Viewing, 1, n_envs=1)
    restore_environment(again, environment_state(env))
    np.testing.assert_array_equal(again.envs[0].unwrapped.limits, task.limits)


class Adapter(gym.Env):
    """Has another environment, and is no wrapper."""

    def __init__(self):
        self.env = PendulumEnv()
        self.action_space, self.observation_space = self.env.action_space, self.env.observation_space

    def reset(self, *, seed=None, options=None):
        return self.env.reset(seed=seed)

    def step(self, action):
        return self.env.step(action)


def test_an_environment_within_one_that_is_no_wrapper_is_an_obstacle():
    register_restorable(Adapter)
    (problem,) = obstacles(make(Adapter, 1, n_envs=1))
    assert "Adapter.env is <gymnasium.envs.classic_control.pendulum.PendulumEnv" in problem


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
    check(partial(make, Shimmy, n_envs=1), steps=65, then=70)


def test_tasks_of_dm_control_that_hold_more_are_not_restorable(monkeypatch):
    env = make(Shimmy, 1, n_envs=1)
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
