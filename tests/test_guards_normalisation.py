"""``VecNormalize`` that is forgotten, new, or in the wrong place."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from guarded import ACTIONS, SMALL, GuardedTD3, Located, located, make
from gymnasium import spaces
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecEnvWrapper,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
    VecTransposeImage,
)

from sb3_cgp import CGP

FORGOTTEN = (
    r"`env` is .* must normalise observations, .* `load\(path, env=VecNormalize.load\(statistics, env\)\)`, or `set_env`"
)
ADDED = "learnt from observations that were not normalised, and `env` normalises them now"
NEW = "the `VecNormalize` of `env` has new statistics"


def make_model(env, **kwargs):
    return GuardedTD3("MlpPolicy", env, **(SMALL | kwargs))


def saved(model, folder):
    model.save(folder / "model")
    return folder / "model"


@pytest.mark.parametrize("raw", [located, lambda: VecNormalize(located(), norm_obs=False)], ids=["none", "norm_obs=False"])
def test_observations_that_are_no_longer_normalised_are_refused(raw, tmp_path):
    model = make_model(VecNormalize(located())).learn(20)
    for forgetful in (GuardedTD3.load(saved(model, tmp_path), raw()), model):
        forgetful.set_env(raw())
        with pytest.raises(ValueError, match=FORGOTTEN):
            forgetful.learn(20)
        # It is not forgotten by having asked, nor by another round through a file
        with pytest.raises(ValueError, match=FORGOTTEN):
            forgetful.learn(20, reset_num_timesteps=False)
        again = GuardedTD3.load(saved(forgetful, tmp_path), raw())
        with pytest.raises(ValueError, match=FORGOTTEN):
            again._check_normalisation()


@pytest.mark.filterwarnings("error")
def test_saved_statistics_are_the_remedy(tmp_path):
    normalizer = VecNormalize(located())
    path = saved(make_model(normalizer).learn(20), tmp_path)
    normalizer.save(tmp_path / "statistics")
    loaded = GuardedTD3.load(path, VecNormalize.load(tmp_path / "statistics", located()))
    loaded.learn(20)
    loaded.learn(20, reset_num_timesteps=False)


def test_new_statistics_are_warned_of_and_leave_observations_as_they_are_where_that_is_asked_for(tmp_path):
    path = saved(make_model(VecNormalize(located())).learn(20), tmp_path)
    for env in (VecNormalize(located()), VecNormalize(located(), training=False)):
        with pytest.warns(UserWarning, match=NEW) as warned:
            GuardedTD3.load(path, env).learn(20)
        assert len(warned) == 1
    # As the error for raw observations advises
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loaded = GuardedTD3.load(path, VecNormalize(located(), training=False, clip_obs=float("inf"))).learn(20)
    observations = np.array([[300.0, 4.0]], np.float32)
    np.testing.assert_allclose(loaded.get_vec_normalize_env().normalize_obs(observations), observations, rtol=1e-6)


@pytest.mark.filterwarnings("error")
def test_saved_statistics_that_do_not_grow_are_not_taken_for_new_ones(tmp_path):
    normalizer = VecNormalize(located())
    path = saved(make_model(normalizer).learn(20), tmp_path)
    normalizer.save(tmp_path / "statistics")
    env = VecNormalize.load(tmp_path / "statistics", located())
    env.training = False
    # Longer than the training that made the statistics
    GuardedTD3.load(path, env).learn(60)


@pytest.mark.filterwarnings("error")
def test_a_model_that_learnt_nothing_may_change_its_mind():
    model = make_model(VecNormalize(located()), gradient_steps=0).learn(20)
    model.set_env(located())
    model.gradient_steps = 1
    model.learn(20)
    model.set_env(VecNormalize(located(), norm_obs=False))
    model.learn(20)


def test_normalisation_that_is_added_later_is_warned_of(tmp_path):
    path = saved(make_model(located()).learn(20), tmp_path)
    with pytest.warns(UserWarning, match=ADDED):
        GuardedTD3.load(path, VecNormalize(located())).learn(20)


class Images(gym.Env):
    action_space = ACTIONS

    def __init__(self, shape=(36, 36, 3)):
        self.observation_space = spaces.Box(0, 255, shape, np.uint8)

    def reset(self, *, seed=None, options=None):
        return self.observation_space.sample(), {}

    def step(self, action):
        return self.observation_space.sample(), 0.0, False, False, {}


class Negated(VecEnvWrapper):
    def reset(self):
        return -self.venv.reset()

    def step_wait(self):
        observations, *others = self.venv.step_wait()
        return -observations, *others


def images(**kwargs):
    return DummyVecEnv([lambda: Images(**kwargs)])


@pytest.mark.parametrize(
    ("make_env", "policy", "name"),
    [
        (lambda: VecNormalize(images(), norm_obs=False), "CnnPolicy", "VecTransposeImage"),
        (lambda: VecTransposeImage(VecNormalize(images(), norm_obs=False)), "CnnPolicy", "VecTransposeImage"),
        (lambda: VecFrameStack(VecNormalize(located()), 2), "MlpPolicy", "VecFrameStack"),
        (lambda: VecMonitor(VecFrameStack(VecMonitor(VecNormalize(located())), 2)), "MlpPolicy", "VecFrameStack"),
    ],
)
def test_wrappers_that_change_observations_after_normalisation_are_refused(make_env, policy, name):
    with pytest.raises(ValueError, match=rf"{name} must not lie outside of VecNormalize.* `VecNormalize\({name}\(\.\.\.\)\)`"):
        GuardedTD3(policy, make_env(), **(SMALL | dict(buffer_size=20)))


def test_they_are_refused_wherever_an_environment_is_given(tmp_path):
    model = make_model(VecFrameStack(located(), 2)).learn(20)
    wrong = VecFrameStack(VecNormalize(located()), 2)
    path, before = saved(model, tmp_path), model.get_env()
    with pytest.raises(ValueError, match="VecFrameStack must not lie outside"):
        model.set_env(wrong)
    assert model.get_env() is before
    with pytest.raises(ValueError, match="VecFrameStack must not lie outside"):
        GuardedTD3.load(path, wrong)


@pytest.mark.parametrize(
    ("make_env", "policy"),
    [
        (lambda: VecNormalize(VecTransposeImage(images()), norm_obs=False), "CnnPolicy"),
        (lambda: VecNormalize(images(shape=(3, 36, 36)), norm_obs=False), "CnnPolicy"),
        (lambda: VecNormalize(VecFrameStack(located(), 2)), "MlpPolicy"),
        (lambda: VecMonitor(VecNormalize(located())), "MlpPolicy"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_the_order_that_the_message_names_works(make_env, policy):
    GuardedTD3(policy, make_env(), **(SMALL | dict(buffer_size=20, batch_size=2))).learn(9)


class Bounded(VecEnvWrapper):
    """Has other bounds than what it wraps."""

    def __init__(self, venv):
        super().__init__(venv, spaces.Box(-20, 20, venv.observation_space.shape))

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        return self.venv.step_wait()


def test_a_wrapper_that_changes_bounds_alone_may_lie_outside():
    assert make_model(Bounded(VecNormalize(located()))).learn(20)._n_updates == 14


def test_a_wrapper_that_changes_values_after_normalisation_is_noticed():
    model = make_model(Negated(VecNormalize(DummyVecEnv([Located]))))
    with pytest.raises(ValueError, match="not those that VecNormalize returned"):
        model.learn(20)
    make_model(VecNormalize(Negated(located()))).learn(20)


def test_a_policy_is_not_trained_on_observations_that_are_no_longer_normalised(tmp_path):
    model = make("MlpPolicy", VecNormalize(located())).learn(20)
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = CGP.load(saved(model, tmp_path))
    loaded.load_replay_buffer(tmp_path / "buffer")
    with pytest.raises(ValueError, match=FORGOTTEN):
        loaded.train_policy(3)
