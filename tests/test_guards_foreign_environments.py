"""Vectorised environments of other packages: arrays that they overwrite, and what they lack."""

import copy
import pickle
from collections import ChainMap, OrderedDict, UserDict

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from guarded import IGNORED_WARNINGS, SMALL, GuardedTD3, Located, assert_no_episode_runs_into_another, located, make_model
from stable_baselines3 import TD3
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper, VecMonitor, VecNormalize
from trainings import Do

pytestmark = IGNORED_WARNINGS


class Overwriting(VecEnvWrapper):
    """Returns one array, which it overwrites at the next step, as an environment for GPUs or in shared memory may."""

    def reset(self):
        self.shared = self.venv.reset()
        return self.shared

    def step_wait(self):
        observations, *others = self.venv.step_wait()
        self.shared[:] = observations
        return self.shared, *others


def test_an_array_that_the_environment_overwrites_is_copied():
    model = make_model("n-step", env=Overwriting(located(2)))
    model.learn(30)
    model.learn(30, reset_num_timesteps=False)
    assert_no_episode_runs_into_another(model.replay_buffer, n_steps=3)
    assert model.replay_buffer.dones.sum() == 2 * (30 // 7)


class Reusing(Located):
    """Keeps its observation in one array, which `reset` overwrites."""

    def __init__(self):
        super().__init__()
        self.array = np.zeros(2, np.float32)

    def observe(self):
        self.array[:] = self.episode, self.steps
        return self.array


def test_a_final_observation_that_reset_overwrites_is_copied():
    model = make_model("n-step", env=DummyVecEnv([Reusing, Reusing]))
    model.learn(60)
    assert_no_episode_runs_into_another(model.replay_buffer, n_steps=3)
    ends = model.replay_buffer.dones[:30] == 1
    np.testing.assert_array_equal(model.replay_buffer.next_observations[:30][ends][:, 1], 7)


class Forwarding(gym.Wrapper):
    """Is one with what it wraps: attributes that are set on it are the environment's own."""

    def __setattr__(self, name, value):
        super().__setattr__(name, value) if name.startswith("_") or name == "env" else setattr(self.env, name, value)


class Restarting(Located):
    """Begins its next episode by itself, by a positional call of its own method."""

    def reset(self, seed=None, options=None):
        return super().reset(seed=seed, options=options)

    def step(self, action):
        returned = super().step(action)
        if returned[3]:
            self.reset(None)
        return returned


@pytest.mark.parametrize("make_env", [lambda: Forwarding(Reusing()), Restarting], ids=["forwarding", "restarting"])
def test_environments_that_a_method_of_another_kind_would_break_are_trained_on(make_env):
    model = make_model("n-step", env=DummyVecEnv([make_env]))
    model.learn(30)
    assert model.replay_buffer.dones.sum() == 30 // 7
    assert "reset" not in vars(model.env.envs[0].unwrapped)
    model.learn(30)
    assert_no_episode_runs_into_another(model.replay_buffer, n_steps=3)


def copy_attributes(env):
    return copy.deepcopy(vars(env))


def copy_with_pickle(env):
    return pickle.loads(pickle.dumps(vars(env)))


@pytest.mark.parametrize("snapshot", [copy_attributes, copy_with_pickle])
def test_an_environment_may_go_back_to_a_copy_of_its_attributes(snapshot):
    class LookingAhead(Located):
        def step(self, action):
            before = snapshot(self)
            super().step(action)
            vars(self).update(before)
            return super().step(action)

    model = make_model("n-step", env=DummyVecEnv([LookingAhead])).learn(30)
    assert model.env.envs[0].steps == 30 % 7
    assert model.replay_buffer.dones.sum() == 30 // 7
    assert_no_episode_runs_into_another(model.replay_buffer, n_steps=3)


def test_the_environments_are_in_their_list_during_a_training_and_after_it():
    def replace():
        assert isinstance(model.env.envs, list)
        assert model.env.envs[0] is model.get_env().get_attr("unwrapped")[0] is first
        assert type(copy.deepcopy(model.env).envs) is type(pickle.loads(pickle.dumps(model.env.envs))) is list
        model.env.envs[0] = second

    first, second = Located(), Located(length=3)
    second.reset()
    model = make_model("plain", env=DummyVecEnv([lambda: first]))
    envs = model.env.envs
    model.learn(20, Do(7, replace))
    assert model.env.envs is envs
    assert envs == [second]
    assert second.steps == 13 % 3


class Restored(Located):
    """Has infos of an environment within, whose episodes end when its own do not."""

    def step(self, action):
        *others, info = super().step(action)
        return *others, info | ({"terminal_observation": np.zeros(5)} if self.steps == 3 else {})


@pytest.mark.parametrize("wrap", [lambda env: env, VecMonitor])
@pytest.mark.parametrize("algorithm", [TD3, GuardedTD3])
def test_an_environment_may_have_the_key_of_final_observations_elsewhere(algorithm, wrap):
    model = algorithm("MlpPolicy", wrap(DummyVecEnv([Restored])), **SMALL).learn(20)
    assert model.replay_buffer.dones.sum() == 20 // 7


class Overflowing(Located):
    """Ends its second episode with an infinite observation."""

    ends = 0

    def step(self, action):
        observation, *others = super().step(action)
        self.ends += self.steps == self.length
        is_second = self.steps == self.length and self.ends == 2
        return np.full(2, np.inf, np.float32) if is_second else observation, *others


class Iterating(DummyVecEnv):
    """Takes each environment once in a step."""

    def step_wait(self):
        for index, env in enumerate(self.envs):
            observation, self.buf_rews[index], terminated, truncated, info = env.step(self.actions[index])
            self.buf_dones[index], self.buf_infos[index] = terminated or truncated, info
            info["TimeLimit.truncated"] = truncated and not terminated
            if self.buf_dones[index]:
                info["terminal_observation"] = observation
                observation, self.reset_infos[index] = env.reset()
            self._save_obs(index, observation)
        return self._obs_from_buf(), self.buf_rews.copy(), self.buf_dones.copy(), copy.deepcopy(self.buf_infos)


@pytest.mark.parametrize("vec_env", [DummyVecEnv, Iterating])
def test_an_infinite_final_observation_is_refused_before_it_is_clipped(vec_env):
    model = GuardedTD3("MlpPolicy", VecNormalize(vec_env([Overflowing])), **SMALL)
    with pytest.raises(ValueError, match=r"NaN or infinite \(in float32\) terminal observation at environment step 14"):
        model.learn(30)
    assert np.isfinite(model.replay_buffer.next_observations).all()


def test_what_a_nested_training_has_refused_does_not_end_the_outer_one():
    env = VecNormalize(DummyVecEnv([Overflowing]))

    def train():
        with pytest.raises(ValueError, match="terminal observation"):
            GuardedTD3("MlpPolicy", env, **SMALL).learn(30)

    assert GuardedTD3("MlpPolicy", env, **SMALL).learn(30, Do(5, train)).num_timesteps == 30


def test_the_environments_may_be_held_in_another_way():
    class Computed(DummyVecEnv):
        envs = property(lambda self: self.kept, lambda self, envs: vars(self).update(kept=envs))

    held = DummyVecEnv([Located])
    held.envs = tuple(held.envs)
    for env in (held, Computed([Located])):
        assert GuardedTD3("MlpPolicy", env, **SMALL).learn(20).replay_buffer.dones.sum() == 20 // 7
    assert type(held.envs) is tuple


class Tensors(VecEnvWrapper):
    """Returns observations as tensors."""

    def reset(self):
        return th.as_tensor(self.venv.reset())

    def step_wait(self):
        observations, *others, infos = self.venv.step_wait()
        for info in infos:
            info.pop("terminal_observation", None)
        return th.as_tensor(observations), *others, infos


def test_an_episode_of_tensors_goes_on_in_a_second_training():
    model = make_model("n-step", env=Tensors(located()))
    model.learn(10).learn(10, reset_num_timesteps=False)
    np.testing.assert_array_equal(model.replay_buffer.dones[:20].nonzero()[0], [6, 13])
    assert model.replay_buffer.timeouts[:20].nonzero()[0].tolist() == [6, 13]


class WithParts(Located):
    """Observes mappings that are no dictionaries."""

    def __init__(self, kind):
        super().__init__(goals=True)
        self.kind = kind

    def observe(self):
        return self.kind(super().observe())


@pytest.mark.parametrize("kind", [dict, OrderedDict, UserDict, ChainMap])
@pytest.mark.parametrize("wrap", [lambda env: env, VecMonitor])
def test_observations_may_be_any_mapping(wrap, kind):
    model = GuardedTD3("MultiInputPolicy", wrap(DummyVecEnv([lambda: WithParts(kind)])), **SMALL).learn(20)
    assert model._n_updates == 14


class Commenting(Located):
    """Has a key in its observations that their space lacks."""

    def __init__(self):
        super().__init__(goals=True)

    def observe(self):
        return super().observe() | {"note": "running", "unknown": np.nan}


@pytest.mark.parametrize("wrap", [lambda env: env, VecNormalize, VecMonitor])
def test_keys_that_the_observation_space_lacks_are_not_looked_at(wrap):
    guarded, plain = (
        algorithm("MultiInputPolicy", wrap(DummyVecEnv([Commenting])), **SMALL).learn(20) for algorithm in (GuardedTD3, TD3)
    )
    assert guarded._n_updates == plain._n_updates == 14
    np.testing.assert_array_equal(guarded.replay_buffer.dones, plain.replay_buffer.dones)


class Foreign(VecEnv):
    """A vectorised environment of another package, which keeps neither actions nor infos, as simulators on a GPU."""

    def __init__(self, infos):
        self.inner, self.infos = Located(), infos
        super().__init__(1, self.inner.observation_space, self.inner.action_space)

    @property
    def reset_infos(self):
        return None if self.infos is None else [{}]

    @reset_infos.setter
    def reset_infos(self, infos):
        pass

    def reset(self):
        return self.inner.reset()[0][None]

    def step_async(self, actions):
        self.given = actions

    def step_wait(self):
        observation, reward, terminated, truncated, info = self.inner.step(self.given[0])
        if terminated or truncated:
            info = {"terminal_observation": observation, "TimeLimit.truncated": truncated}
            observation = self.inner.reset()[0]
        return observation[None], np.array([reward]), np.array([terminated or truncated]), [info]

    def close(self):
        pass

    def get_attr(self, attr_name, indices=None):
        return [getattr(self.inner, attr_name)]

    def set_attr(self, attr_name, value, indices=None):
        raise NotImplementedError

    def env_method(self, method_name, *args, indices=None, **kwargs):
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class, indices=None):
        return [False]


class ToSimulator(VecEnvWrapper):
    """Says that what it wraps is a simulator, as a robot's package does."""

    @property
    def unwrapped(self):
        return object()

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        return self.venv.step_wait()


@pytest.mark.parametrize("infos", [None, "new ones"])
@pytest.mark.parametrize("wrap", [lambda env: env, VecMonitor, VecNormalize, ToSimulator])
def test_environments_of_other_packages_are_trained_on_as_by_sb3(infos, wrap):
    guarded, plain = (algorithm("MlpPolicy", wrap(Foreign(infos)), **SMALL).learn(30) for algorithm in (GuardedTD3, TD3))
    assert guarded._n_updates == plain._n_updates == 24
    np.testing.assert_array_equal(guarded.replay_buffer.dones, plain.replay_buffer.dones)
    assert_no_episode_runs_into_another(guarded.replay_buffer) if wrap is not VecNormalize else None
