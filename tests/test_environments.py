"""Environments' states: whatever they are put back into goes on as the original does, to the bit."""

import re
from collections import OrderedDict, deque
from copy import deepcopy
from functools import partial
from itertools import pairwise
from types import SimpleNamespace

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from environments import Doubles
from gymnasium import spaces, wrappers
from gymnasium.wrappers.utils import RunningMeanStd as GymnasiumRunningMeanStd
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as st_numpy
from rl_zoo3 import wrappers as zoo_wrappers
from rl_zoo3.utils import get_wrapper_class
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecCheckNan,
    VecExtractDictObs,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
    VecTransposeImage,
)

from sb3_cgp.resumption.environments import RestorableEnv, environment_state, restore_environment, why_not_restorable
from sb3_cgp.resumption.plain_data import NotPlainError, from_plain, plain_attributes, set_plain_attributes, to_plain

MUJOCO_TASKS = (
    *("Ant", "HalfCheetah", "Hopper", "Humanoid", "HumanoidStandup", "InvertedDoublePendulum", "InvertedPendulum"),
    *("Pusher", "Reacher", "Swimmer", "Walker2d"),
)
TASKS = ("Pendulum-v1", "MountainCarContinuous-v0", *(f"{task}-v5" for task in MUJOCO_TASKS))
PLAIN_SCALARS = (type(None), bool, int, float, str, bytes)


def assert_same(one, other):
    """Compare two values to the bit, their types and their order included."""
    assert type(one) is type(other)
    if isinstance(one, dict):
        assert list(one) == list(other)
        one, other = one.values(), other.values()
    if isinstance(one, np.ndarray | np.generic):
        assert (one.dtype, one.shape) == (other.dtype, other.shape)
        assert one.tobytes() == other.tobytes()
    elif isinstance(one, list | tuple | deque | type({}.values())):
        assert len(one) == len(other)
        for pair in zip(one, other, strict=True):
            assert_same(*pair)
    else:
        assert repr(one) == repr(other)


def assert_plain(value):
    """Expect nothing that JSON and arrays could not hold."""
    if type(value) is dict:
        assert all(type(key) in (str, int) for key in value)
        value = list(value.values())
    if type(value) in (list, tuple):
        for each in value:
            assert_plain(each)
    elif type(value) is np.ndarray or isinstance(value, np.generic):
        assert value.dtype.kind in "biufc"
    else:
        assert type(value) in PLAIN_SCALARS


def go_on(env, steps):
    """Act at random, by the environment's own action space, and note all that it returns."""
    seen = []
    for _ in range(steps):
        actions = np.stack([env.action_space.sample() for _ in range(env.num_envs)])
        seen.append(deepcopy((actions, *env.step(actions), env.reset_infos)))
        for info in seen[-1][4]:
            # Time on the clock
            info.get("episode", {}).pop("t", None)
    return [*seen, deepcopy(env.reset()), [env.action_space.sample(), env.observation_space.sample()]]


def start(env, steps):
    env.action_space.seed(3)
    env.observation_space.seed(4)
    env.reset()
    go_on(env, steps)
    # `go_on` ends with a reset
    for _ in range(steps % 10):
        env.step(np.stack([env.action_space.sample() for _ in range(env.num_envs)]))
    return env


def check(make, steps=47, then=60):
    """Expect that a fresh and a used environment go on as the original does; ``make`` takes a seed."""
    original, fresh, used = start(make(5), steps), make(None), start(make(6), 13)
    try:
        state = environment_state(original)
        assert why_not_restorable(original) is None
        assert_plain(state)
        copy = deepcopy(state)
        expected = go_on(original, then)
        assert_same(state, copy)
        other = environment_state(used)
        for env in (fresh, used):
            restore_environment(env, state)
            assert_same(environment_state(env), copy)
            assert_same(go_on(env, then), expected)
        assert_same(state, copy)
        restore_environment(used, other)
        with pytest.raises(AssertionError):
            assert_same(go_on(used, then), expected)
    finally:
        for env in (original, fresh, used):
            env.close()


# Tasks


def make_task(task, seed, n_envs=2, limit=70, **kwargs):
    return make_vec_env(task, n_envs, seed, env_kwargs=dict(max_episode_steps=limit), **kwargs)


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


# Wrappers


class Total(gym.Wrapper):
    """A user's wrapper with a state of its own: the rewards so far, which are what it returns."""

    def __init__(self, env):
        super().__init__(env)
        self.rewards = [0.0]

    def step(self, action):
        observation, reward, *rest = self.env.step(action)
        self.rewards.append(float(reward))
        return observation, sum(self.rewards), *rest

    def get_training_state(self):
        return self.rewards

    def set_training_state(self, state):
        self.rewards = state


class Clockless(gym.Wrapper):
    """A user's wrapper without a state, which drops the time on the clock."""

    def step(self, action):
        *rest, info = self.env.step(action)
        if "statistics" in info:
            del info["statistics"]["t"]
        return *rest, info

    def get_training_state(self):
        return ()

    def set_training_state(self, state):
        assert state == ()


WRAPPERS = {
    "RescaleAction": lambda env: wrappers.RescaleAction(env, np.float32(-1), np.float32(1)),
    "ClipAction and ClipReward": lambda env: wrappers.ClipReward(wrappers.ClipAction(env), -1.0, 1.0),
    "TransformReward": lambda env: wrappers.TransformReward(env, lambda reward: 2 * reward),
    "FrameStack and Flatten": lambda env: wrappers.FlattenObservation(wrappers.FrameStackObservation(env, 3)),
    "DelayObservation": lambda env: wrappers.DelayObservation(env, 4),
    "MaxAndSkipObservation": lambda env: wrappers.MaxAndSkipObservation(env, 2),
    "TimeAwareObservation": wrappers.TimeAwareObservation,
    "Normalize": lambda env: wrappers.NormalizeReward(wrappers.NormalizeObservation(env)),
    "StickyAction": lambda env: wrappers.StickyAction(env, 0.5, (2, 3)),
    "RecordEpisodeStatistics": lambda env: Clockless(wrappers.RecordEpisodeStatistics(env, stats_key="statistics")),
    "HistoryWrapper": lambda env: zoo_wrappers.HistoryWrapper(env, 3),
    "ActionSmoothingWrapper": lambda env: zoo_wrappers.ActionSmoothingWrapper(env, 0.5),
    "DelayedRewardWrapper": lambda env: zoo_wrappers.DelayedRewardWrapper(env, 7),
    "FrameSkip": zoo_wrappers.FrameSkip,
    "TimeFeatureWrapper": zoo_wrappers.TimeFeatureWrapper,
    "MaskVelocityWrapper": zoo_wrappers.MaskVelocityWrapper,
    "a user's": lambda env: Monitor(Total(RestorableEnv(env))),
}
PENDULUM = partial(make_task, "Pendulum-v1", limit=20)


# Before the second step, Gymnasium's checker holds what it saw last
@pytest.mark.parametrize("steps", [0, 1, 47])
@pytest.mark.parametrize("name", WRAPPERS)
def test_wrappers_go_on_to_the_bit(name, steps):
    check(partial(PENDULUM, wrapper_class=WRAPPERS[name]), steps)


VEC_WRAPPERS = {
    "VecNormalize": VecNormalize,
    "VecNormalize of observations": lambda env: VecNormalize(env, norm_reward=False),
    "VecFrameStack": lambda env: VecFrameStack(env, 3),
    "all": lambda env: VecFrameStack(VecNormalize(VecCheckNan(VecMonitor(env), raise_exception=True), clip_obs=2.0), 2),
}


@pytest.mark.filterwarnings("ignore:The environment is already wrapped with a `Monitor`")
@pytest.mark.parametrize("name", VEC_WRAPPERS)
def test_vectorized_wrappers_go_on_to_the_bit(name):
    check(lambda seed: VEC_WRAPPERS[name](PENDULUM(seed, n_envs=3)))


def test_normalization_is_put_back():
    original, other = (start(VecNormalize(PENDULUM(seed)), 23 + seed) for seed in (1, 2))
    statistics = other.obs_rms
    restore_environment(other, environment_state(original))
    assert other.obs_rms is statistics, "an environment to evaluate in may share the statistics"
    for one, another in ((other.obs_rms, original.obs_rms), (other.ret_rms, original.ret_rms)):
        assert_same(vars(one), vars(another))
    assert_same(other.returns, original.returns)
    assert np.all(other.returns != 0)
    assert_same(other.get_original_obs(), original.get_original_obs())
    assert_same(other.get_original_reward(), original.get_original_reward())


def test_a_monitors_file_and_clock_stay_its_own(tmp_path):
    original, other = (PENDULUM(seed, monitor_dir=str(tmp_path / str(seed))) for seed in (1, 2))
    start(original, 30)
    monitor = other.envs[0]
    own = monitor.t_start, monitor.results_writer
    restore_environment(other, environment_state(original))
    assert (monitor.t_start, monitor.results_writer) == own
    assert monitor.episode_returns == original.envs[0].episode_returns != []
    go_on(other, 20)
    assert len((tmp_path / "2" / "0.monitor.csv").read_text().splitlines()) == 3


# Users' environments


class Goal(Doubles):
    """A user's environment of dictionaries and images, whose state is not in plain attributes alone."""

    observation_space = spaces.Dict(
        vector=spaces.Box(-np.inf, np.inf, (3,), np.float32), image=spaces.Box(0, 255, (36, 36, 3), np.uint8)
    )

    def __init__(self):
        self.action_space = spaces.Box(-1, 1, (2,), np.float32)
        self.simulator = SimpleNamespace(position=0.0, visited={})

    def observe(self):
        vector = self.np_random.normal(size=3).astype(np.float32) + np.float32(self.simulator.position)
        return dict(vector=vector, image=self.np_random.integers(0, 256, (36, 36, 3), np.uint8))

    def step(self, action):
        self.simulator.position += float(action.sum())
        self.simulator.visited[self.steps, 0] = self.simulator.position
        observation, _, *ends, info = super().step(action)
        return observation, sum(self.simulator.visited.values()), *ends, info | dict(visited=len(self.simulator.visited))

    def get_training_state(self):
        return dict(steps=getattr(self, "steps", None), **vars(self.simulator))

    def set_training_state(self, state):
        self.steps = state.pop("steps")
        vars(self.simulator).update(state)


class Inherits(Doubles):
    """Without the two methods."""


def make_goal(seed, environment=Goal, wrap=lambda env: env):
    env = wrap(DummyVecEnv([environment, environment]))
    env.seed(seed)
    return env


@pytest.mark.parametrize(
    "wrap",
    [
        lambda env: env,
        VecTransposeImage,
        lambda env: VecFrameStack(env, 3),
        lambda env: VecNormalize(env, norm_obs_keys=["vector"]),
        lambda env: VecNormalize(VecExtractDictObs(env, "vector")),
    ],
    ids=["plain", "VecTransposeImage", "VecFrameStack", "VecNormalize", "VecExtractDictObs"],
)
def test_users_environments_that_take_part_go_on_to_the_bit(wrap):
    check(partial(make_goal, wrap=wrap), steps=13, then=22)


def test_users_environments_and_wrappers_that_do_not_take_part_are_not_restorable():
    assert environment_state(make_goal(1, Inherits)) is None
    assert "Inherits is unknown and has no get_training_state()" in why_not_restorable(make_goal(1, Inherits))
    assert environment_state(PENDULUM(1, wrapper_class=type("Wrapper", (gym.Wrapper,), {}))) is None
    assert environment_state(type("Wrapper", (VecNormalize,), {})(PENDULUM(1))) is None
    with pytest.raises(ValueError, match=r"`env` is .*, but must be restorable"):
        restore_environment(make_goal(1, Inherits), environment_state(make_goal(1)))


def test_state_that_is_no_plain_data_is_noticed():
    env = PENDULUM(1)
    assert environment_state(env) is not None
    env.envs[1].unwrapped.goal = SimpleNamespace()
    assert environment_state(env) is None
    assert re.fullmatch(r".*PendulumEnv\.goal is namespace\(\), which is not plain data\.", why_not_restorable(env))
    env.envs[1].unwrapped.goal = env.action_space
    assert environment_state(env) is not None
    env.simulator = deque([object()])
    assert environment_state(env) is None


def test_infos_may_hold_anything():
    env = make_goal(1)
    env.reset_infos = [{"simulator": object()}] * 2
    assert environment_state(env) is not None


def test_rendering_does_not_matter():
    env = make_task("Pendulum-v1", 1)
    env.reset()
    env.envs[0].render()
    assert environment_state(env) is not None
    # Else pygame goes on to take SIGTERM for an event, in this process and in those that are forked off it
    env.close()


def test_a_user_may_decline_and_must_return_plain_data(monkeypatch):
    env = make_goal(1)
    monkeypatch.setattr(Goal, "get_training_state", lambda self: None)
    assert environment_state(env) is None
    monkeypatch.setattr(Goal, "get_training_state", lambda self: self.simulator)
    with pytest.raises(ValueError, match=r"Goal\.get_training_state\(\) returned namespace.* must return plain data"):
        environment_state(env)


# Other processes


def make_processes(seed, wrapper_class=RestorableEnv, wrap=VecNormalize):
    subprocesses = dict(vec_env_cls=SubprocVecEnv, vec_env_kwargs=dict(start_method="fork"))
    return wrap(PENDULUM(seed, wrapper_class=wrapper_class, **subprocesses))


def test_environments_in_other_processes_go_on_to_the_bit():
    # The noise is drawn from the process's own generator
    noise = {"rl_zoo3.wrappers.ActionNoiseWrapper": dict(noise_std=0.3)}
    env_wrapper = get_wrapper_class(dict(env_wrapper=[noise, "sb3_cgp.resumption.environments.RestorableEnv"]))
    check(partial(make_processes, wrapper_class=env_wrapper))


@pytest.mark.parametrize(
    "wrapper_class",
    [
        None,
        lambda env: Monitor(RestorableEnv(env)),
        Total,
        lambda env: RestorableEnv(type("Wrapper", (gym.Wrapper,), {})(env)),
    ],
    ids=["none", "not outermost", "a user's", "around a user's"],
)
def test_environments_in_other_processes_that_cannot_be_reached(wrapper_class):
    env = make_processes(1, wrapper_class)
    try:
        assert environment_state(env) is None
        # The processes are still there
        env.reset()
    finally:
        env.close()


# What does not fit


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


# Attributes

KEYS = st.none() | st.booleans() | st.integers() | st.text() | st.just("__type__") | st.tuples(st.integers(), st.binary())
NUMBERS = st_numpy.boolean_dtypes() | st_numpy.integer_dtypes() | st_numpy.floating_dtypes() | st_numpy.complex_number_dtypes()
ARRAYS = NUMBERS.flatmap(lambda dtype: st_numpy.arrays(dtype, st_numpy.array_shapes(min_dims=0, min_side=0, max_side=3)))
VALUES = st.recursive(
    st.floats() | KEYS | ARRAYS | ARRAYS.map(np.transpose) | NUMBERS.flatmap(st_numpy.from_dtype),
    lambda inside: st.one_of(
        st.lists(inside, max_size=3),
        st.lists(inside, max_size=3).map(tuple),
        st.dictionaries(KEYS, inside, max_size=3),
        st.dictionaries(KEYS, inside, max_size=3).map(OrderedDict),
        st.builds(deque, st.lists(inside, max_size=3), st.none() | st.integers(3, 5)),
    ),
    max_leaves=8,
)


@given(VALUES)
def test_values_make_the_round_trip(value):
    plain = to_plain(value)
    assert_plain(plain)
    assert_same(from_plain(plain), value)


@pytest.mark.parametrize("value", [deque([1], 4), {1, 2}, frozenset({"a"}), {0: [{}]}, OrderedDict(a=1)])
def test_collections_keep_their_kind(value):
    again = from_plain(to_plain(value))
    assert type(again) is type(value)
    assert again == value
    assert getattr(again, "maxlen", None) == getattr(value, "maxlen", None)


@pytest.mark.parametrize(
    "value",
    [
        object(),
        np.array([None]),
        np.array(["a"]),
        np.datetime64("2020-01-01"),
        np.ma.masked_array([1]),
        np.zeros(2, "i4,f4"),
        np.random.RandomState(),
        SimpleNamespace(),
        len,
        type("Integer", (int,), {})(1),
        type("Mapping", (dict,), {})(),
    ],
)
def test_other_values_are_left_out(value):
    for each in (value, [value], {"key": (value,)}):
        with pytest.raises(NotPlainError):
            to_plain(each)
    assert plain_attributes(SimpleNamespace(value=value, held=[value], other=1)) == {"other": 1}


def test_attributes_are_copied_there_and_back():
    itself = []
    itself.append(itself)
    source = SimpleNamespace(values=np.arange(3.0), held=[np.zeros(2)], itself=itself, model=1)
    state = plain_attributes(source, without=("model",))
    assert list(state) == ["values", "held"]
    target = SimpleNamespace(values=None, kept=1)
    set_plain_attributes(target, state)
    for changed in (source, target):
        changed.values += 1.0
        changed.held[0] += 1.0
    assert_same(state, {"values": np.arange(3.0), "held": [np.zeros(2)]})
    assert target.kept == 1
    assert not hasattr(target, "model")


def test_arrays_keep_their_layout():
    values = np.asfortranarray(np.random.default_rng(1).normal(size=(5, 7)))
    plain = to_plain(values)
    assert plain.strides == from_plain(plain).strides == values.strides


def test_attributes_go_past_setattr():
    class Redirects:
        def __setattr__(self, name, value):
            pytest.fail("was set elsewhere")

    obj = Redirects()
    set_plain_attributes(obj, {"value": 1})
    assert vars(obj) == {"value": 1}


@pytest.mark.parametrize("kind", ["MT19937", "PCG64", "PCG64DXSM", "Philox", "SFC64"])
def test_generators_that_are_shared_still_are(kind):
    make = getattr(np.random, kind)
    source = SimpleNamespace(generator=np.random.Generator(make(1)))
    source.generator.integers(10, dtype=np.uint32)
    state = plain_attributes(source)
    assert_plain(state)
    expected = source.generator.normal(size=7)
    shared = np.random.Generator(make(2))
    targets = [SimpleNamespace(generator=shared), SimpleNamespace(generator=shared)]
    for target in targets:
        set_plain_attributes(target, state)
    assert targets[0].generator is targets[1].generator is shared
    assert_same(shared.normal(size=7), expected)
    other = np.random.MT19937 if kind != "MT19937" else np.random.PCG64
    for there in (None, np.random.Generator(other(3))):
        target = SimpleNamespace(generator=there)
        set_plain_attributes(target, state)
        assert_same(target.generator.normal(size=7), expected)


@pytest.mark.parametrize("kind", [RunningMeanStd, GymnasiumRunningMeanStd])
def test_running_statistics_make_the_round_trip(kind):
    statistics, batches = kind(shape=(2,)), np.random.default_rng(1).normal(size=(3, 4, 2))
    statistics.update(batches[0])
    source = SimpleNamespace(statistics={"key": statistics})
    state = plain_attributes(source)
    assert_plain(state)
    there = kind(shape=(2,))
    targets = [SimpleNamespace(statistics={"key": there}), SimpleNamespace(statistics=None)]
    for target in targets:
        set_plain_attributes(target, state)
    assert targets[0].statistics["key"] is there
    for each in (source, *targets):
        for batch in batches[1:]:
            each.statistics["key"].update(batch)
    for one, other in pairwise((source, *targets)):
        assert type(one.statistics["key"]) is kind
        assert_same(vars(one.statistics["key"]), vars(other.statistics["key"]))


@pytest.mark.parametrize(
    ("plain", "message"),
    [
        ({"__type__": "os.system"}, "`__type__` is 'os.system', but must be one of dict"),
        ({"__type__": "Generator", "state": {"bit_generator": "Popen"}}, "`bit_generator` is 'Popen', but must be one of"),
    ],
)
def test_unknown_types_are_refused(plain, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        set_plain_attributes(SimpleNamespace(), {"value": plain})
