"""States of wrappers and of vectorised environments: they go on as the original does, to the bit."""

from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from environment_states import PENDULUM, assert_same, check, environment_state, go_on, start
from gymnasium import wrappers
from rl_zoo3 import wrappers as zoo_wrappers
from rl_zoo3.utils import get_wrapper_class
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import SubprocVecEnv, VecCheckNan, VecFrameStack, VecMonitor, VecNormalize

from sb3_cgp.resumption.environments import RestorableEnv, restore_environment


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
