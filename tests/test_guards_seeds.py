"""Vectorised environments of other packages without a method ``seed`` are trained on, with a warning."""

import warnings

import numpy as np
import pytest
from guarded import SMALL, GuardedTD3, located
from stable_baselines3.common.vec_env import VecEnvWrapper, VecMonitor, VecNormalize

from sb3_cgp import CGP
from sb3_cgp.guards import GuardedAlgorithm
from sb3_cgp.population import Population


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


class Bare(Pool):
    """Has nothing that SB3's environments alone have."""

    def __getattr__(self, name):
        if name in ("seed", "unwrapped", "_seeds"):
            raise AttributeError(name)
        return super().__getattr__(name)


@pytest.mark.parametrize("pool", [Pool, Bare])
def test_a_population_takes_environments_that_cannot_be_seeded(pool):
    with pytest.warns(UserWarning, match=rf"{pool.__name__} has no method `seed`"):
        population = Population("MlpPolicy", VecMonitor(Adapter(pool())), 2, cem_samples=6, cem_elites=2, **SMALL)
    assert population.learn(20).num_timesteps == 20


def test_a_population_has_all_guards_but_the_trial_of_networks_that_its_agents_make():
    assert issubclass(Population, GuardedAlgorithm)
    assert Population._try_networks is not GuardedAlgorithm._try_networks


@pytest.mark.parametrize("algorithm", [CGP, lambda *args, **kwargs: Population(*args, 2, **kwargs)])
def test_a_model_without_a_seed_leaves_the_environments_theirs(algorithm):
    env = located(2)
    env.seed(7)
    algorithm("MlpPolicy", env, **(SMALL | dict(seed=None)))
    assert env._seeds == [7, 8]


def test_an_agent_without_a_seed_leaves_its_environment_the_seed_it_has():
    env = located(3)
    env.seed(7)
    Population("MlpPolicy", env, [dict(seed=0), dict(seed=None), dict(seed=90)], **SMALL)
    assert env._seeds == [0, 8, 90]


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
