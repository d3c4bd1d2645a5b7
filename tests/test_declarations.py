"""Environments of others that are declared restorable go on to the bit, in this process and in others."""

import threading
from functools import partial
from types import SimpleNamespace

import gymnasium as gym
import pytest
from environment_states import assert_same as assert_same_values
from environment_states import check, environment_state, go_on, obstacles, start
from environments import Doubles
from gymnasium.envs.classic_control import PendulumEnv
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv
from trainings import Training, assert_same, fingerprint

from sb3_cgp import RestorableEnv, register_restorable
from sb3_cgp.resumption import declarations
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
