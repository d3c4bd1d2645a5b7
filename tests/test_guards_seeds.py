"""Vectorised environments of other packages without a method ``seed`` are trained on, with a warning."""

import warnings

import numpy as np
import pytest
from guarded import SMALL, GuardedTD3, located
from stable_baselines3.common.vec_env import VecEnvWrapper, VecMonitor, VecNormalize

from sb3_cgp import CGP


class Pool:
    """A simulator of many environments, of no class of SB3's, which misses one of its methods."""

    def __init__(self, missing="seed"):
        self.inner, self.missing = located(2), missing

    def __getattr__(self, name):
        if name == self.missing:
            raise AttributeError(name)
        return getattr(self.inner, name)


class Adapter(VecEnvWrapper):
    """As packages write it, to make their simulators environments of SB3's."""

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        return self.venv.step_wait()


@pytest.mark.parametrize("wrap", [lambda env: env, VecMonitor, lambda env: VecNormalize(VecMonitor(env))])
@pytest.mark.parametrize("algorithm", [GuardedTD3, CGP])
def test_environments_that_cannot_be_seeded_are_trained_on(algorithm, wrap):
    with pytest.warns(UserWarning, match=r"test_guards_seeds\.Pool has no method `seed`: .* from `seed=0`"):
        model = algorithm("MlpPolicy", wrap(Adapter(Pool())), **SMALL)
    assert model.learn(20).num_timesteps == 20
    # All other random numbers follow from the seed
    actions = [model.action_space.sample()]
    with pytest.warns(UserWarning, match="has no method `seed`"):
        again = algorithm("MlpPolicy", wrap(Adapter(Pool())), **SMALL)
    again.learn(20)
    np.testing.assert_array_equal(again.action_space.sample(), actions[0])


def test_without_a_seed_or_with_the_method_there_is_no_warning():
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*no method `seed`")
        GuardedTD3("MlpPolicy", Adapter(Pool()), **(SMALL | dict(seed=None)))
        GuardedTD3("MlpPolicy", Adapter(Pool(missing="nothing")), **SMALL)


def test_an_error_of_the_environments_own_passes():
    class Broken(Adapter):
        def seed(self, seed=None):
            return object().seed

    with pytest.raises(AttributeError, match="'object' object has no attribute 'seed'"):
        GuardedTD3("MlpPolicy", Broken(Pool()), **SMALL)
