"""Errors that name the cause and the remedy: the old API, an `info` that is none, hindsight without a whole episode."""

import re

import gymnasium as gym
import numpy as np
import pytest
from guarded import SMALL, GuardedTD3, Located, located
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer


class OldReset(Located):
    def reset(self, *, seed=None, options=None):
        return super().reset()[0]


class OlderReset(Located):
    def reset(self):
        return super().reset()[0]


class LongOldReset(OldReset):
    """Three numbers, so that they cannot be taken for an observation and its information."""

    def __init__(self):
        super().__init__()
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (3,))

    def observe(self):
        return np.append(super().observe(), 0)


class EmptyReset(Located):
    def reset(self, *, seed=None, options=None):
        super().reset()


class NoResetInfo(Located):
    def reset(self, *, seed=None, options=None):
        return super().reset()[0], None


class OldStep(Located):
    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        return observation, reward, terminated or truncated, info


class NoInfo(Located):
    def step(self, action):
        return *super().step(action)[:4], None


def bare(env):
    return DummyVecEnv([lambda: env])


def monitored(env):
    return DummyVecEnv([lambda: Monitor(env)])


def wrapped(env):
    return DummyVecEnv([lambda: gym.wrappers.TimeLimit(env, 5)])


class OwnWrapper(gym.Wrapper):
    def step(self, action):
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated, truncated, info

    def reset(self, *, seed=None, options=None):
        observation, info = self.env.reset(seed=seed, options=options)
        return observation, info


def wrapped_by_another_package(env):
    return DummyVecEnv([lambda: OwnWrapper(env)])


@pytest.mark.parametrize("wrap", [bare, monitored, wrapped, wrapped_by_another_package])
@pytest.mark.parametrize(
    ("env", "message"),
    [
        (OldReset, r"`reset` must take `seed` and `options` and return two values"),
        (OlderReset, r"`reset` must take `seed` and `options` and return two values"),
        (LongOldReset, r"`reset` must take `seed` and `options` and return two values"),
        (EmptyReset, r"`reset` must take `seed` and `options` and return two values"),
        (NoResetInfo, r"`reset` must return a dictionary as its last value, `info`; an empty one, `{}`, will do"),
        (OldStep, r"`step` must return five values"),
        (NoInfo, r"`step` must return a dictionary as its last value"),
    ],
)
def test_an_environment_of_an_old_api_or_without_information_is_told_what_to_return(wrap, env, message):
    model = GuardedTD3("MlpPolicy", wrap(env()), **SMALL)
    with pytest.raises(ValueError, match=f"The environment's {message}"):
        model.learn(20)


def test_an_old_reset_is_noticed_within_a_training_too():
    class Late(Located):
        def reset(self, *, seed=None, options=None):
            observation, info = super().reset()
            return (observation, info) if self.episode_count() == 1 else observation

        def episode_count(self):
            self.count = getattr(self, "count", 0) + 1
            return self.count

    model = GuardedTD3("MlpPolicy", bare(Late()), **SMALL)
    with pytest.raises(ValueError, match="`reset` must take"):
        model.learn(20)
    assert model.replay_buffer.size() == 6


@pytest.mark.parametrize(("kind", "message"), [(OldReset, "`reset` must take"), (NoResetInfo, "`reset` must return a dict")])
def test_an_old_reset_of_a_worker_that_passes_for_a_new_one_is_noticed(kind, message):
    env = SubprocVecEnv([kind], start_method="fork")
    model = GuardedTD3("MlpPolicy", env, **SMALL)
    with pytest.raises(ValueError, match=message):
        model.learn(20)
    env.close()


@pytest.mark.parametrize("message", ["not enough values to unpack (expected 5, got 4)", "reset() takes no arguments"])
def test_an_error_of_the_environments_own_code_passes(message):
    class Unpacks(Located):
        def step(self, action):
            raise ValueError(message)

    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        GuardedTD3("MlpPolicy", Unpacks(), **SMALL).learn(20)


class Unpacking(gym.Wrapper):
    def step(self, action):
        first, _ = action.repeat(3)
        return self.env.step(first)


class OldWrapper(gym.Wrapper):
    def step(self, action):
        observation, reward, done, info = self.env.step(action)
        return observation, reward, done, info


class OldWrapperWithAName(OldWrapper):
    def step(self, action):
        self.base_env = self.env
        observation, reward, done, info = self.base_env.step(action)
        return observation, reward, done, info


@pytest.mark.parametrize("wrap", [bare, monitored, wrapped])
@pytest.mark.parametrize("wrapper", [OldWrapper, OldWrapperWithAName])
def test_a_wrapper_of_the_old_api_is_told_what_an_environment_returns(wrapper, wrap):
    with pytest.raises(ValueError, match=r"The environment's `step` must return five values"):
        GuardedTD3("MlpPolicy", wrap(wrapper(Located())), **SMALL).learn(20)


class UnpackingFive(gym.Wrapper):
    def reset(self, *, seed=None, options=None):
        first, *_, _, _, _, _ = np.zeros(3)
        return self.env.reset(seed=first, options=options)


class Assigning(gym.Wrapper):
    def step(self, action):
        bounds = (0, 1)
        bounds[0] = action
        return self.env.step(action)


@pytest.mark.parametrize(
    ("wrapper", "message"),
    [
        (Unpacking, "too many values to unpack"),
        (UnpackingFive, "not enough values"),
        (Assigning, "'tuple' object does not support"),
    ],
)
def test_an_error_of_a_wrappers_own_code_passes(wrapper, message):
    with pytest.raises((TypeError, ValueError), match=message):
        GuardedTD3("MlpPolicy", wrapper(Located()), **SMALL).learn(20)


def test_a_vectorised_environment_of_another_interface_is_told_what_to_return():
    class Five(DummyVecEnv):
        def step_wait(self):
            observations, rewards, dones, infos = super().step_wait()
            return observations, rewards, dones, np.zeros_like(dones), infos

    with pytest.raises(ValueError, match=r"`step_wait` must return four values.*`TimeLimit\.truncated`"):
        GuardedTD3("MlpPolicy", Five([Located]), **SMALL).learn(20)


def test_an_error_of_something_else_that_is_reset_passes():
    class ResetsNoise(gym.Wrapper):
        def reset(self, *, seed=None, options=None):
            NormalActionNoise(np.zeros(1), np.ones(1)).reset(indices=[0])
            return self.env.reset(seed=seed, options=options)

    with pytest.raises(TypeError, match="unexpected keyword argument 'indices'"):
        GuardedTD3("MlpPolicy", ResetsNoise(Located()), **SMALL).learn(20)


def hindsight(n_envs=1, length=7, **kwargs):
    arguments = SMALL | dict(replay_buffer_class=HerReplayBuffer) | kwargs
    return GuardedTD3("MultiInputPolicy", located(n_envs, goals=True, length=length), **arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (dict(learning_starts=6), r"it has 7 steps of each, and the first episode is longer.* raise it to 1 x the longest"),
        # Longer than an episode, as SB3 recommends, but shared by the environments
        (
            dict(n_envs=4, learning_starts=20),
            r"the 4 environment.*it has 6 steps of each.* is 20 and counts .* to 4 x the longest",
        ),
        (dict(buffer_size=10, length=20, learning_starts=30), r"size of 10 steps .* `buffer_size`.* to 2 x the longest"),
    ],
)
def test_hindsight_without_a_whole_episode_says_why_and_what_to_do(arguments, message):
    arguments = dict(length=9) | arguments
    with pytest.raises(ValueError, match=message) as caught:
        hindsight(**arguments).learn(60)
    assert isinstance(caught.value.__cause__, RuntimeError)


@pytest.mark.parametrize(
    "arguments",
    [dict(learning_starts=9), dict(n_envs=4, learning_starts=4 * 9), dict(buffer_size=40, length=20, learning_starts=20)],
)
def test_the_remedies_for_hindsight_work(arguments):
    arguments = dict(length=9) | arguments
    assert hindsight(**arguments).learn(70)._n_updates > 0


def test_hindsight_that_goes_on_without_its_replay_buffer_is_told_to_load_it(tmp_path):
    arguments = dict(length=9, n_envs=2)
    model = hindsight(**arguments, learning_starts=20).learn(60)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    env = located(2, goals=True, length=9)
    loaded = GuardedTD3.load(tmp_path / "model", env)
    message = r"it has 1 steps of each.*`model.load_replay_buffer\(path\)`, or raise it to 60 \+ 2 x the longest episode"
    with pytest.raises(ValueError, match=message):
        loaded.learn(40, reset_num_timesteps=False)
    # Both remedies work
    loaded = GuardedTD3.load(tmp_path / "model", env)
    loaded.load_replay_buffer(tmp_path / "buffer")
    loaded.learn(40, reset_num_timesteps=False)
    GuardedTD3.load(tmp_path / "model", env, learning_starts=60 + 2 * 9).learn(40, reset_num_timesteps=False)
