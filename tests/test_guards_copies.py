"""A copied model has a replay buffer of its own, and goes on where it was."""

import copy
import pickle

import numpy as np
import pytest
from guarded import IGNORED_WARNINGS, SMALL, Located, assert_no_episode_runs_into_another, make_model
from stable_baselines3 import TD3
from stable_baselines3.common.vec_env import DummyVecEnv
from trainings import Do

from sb3_cgp.guards import GuardedAlgorithm

pytestmark = IGNORED_WARNINGS


def test_a_copy_that_is_made_while_it_learns_is_the_models_own():
    model, copies = make_model("n-step"), []
    model.learn(15, Do(9, lambda: copies.extend([copy.deepcopy(model), pickle.loads(pickle.dumps(model))])))
    size = model.replay_buffer.size()
    for each in copies:
        each.learn(20, reset_num_timesteps=False)
        assert_no_episode_runs_into_another(each.replay_buffer, n_steps=3)
    assert model.replay_buffer.size() == size
    model.learn(20, reset_num_timesteps=False)
    assert_no_episode_runs_into_another(model.replay_buffer, n_steps=3)


@pytest.mark.parametrize("copier", [copy.deepcopy, lambda model: pickle.loads(pickle.dumps(model))], ids=["copy", "pickle"])
def test_a_copied_model_goes_on_where_it_was(copier):
    model = make_model("n-step").learn(18)
    other = copier(model)
    other.learn(20, reset_num_timesteps=False)
    np.testing.assert_array_equal(other.replay_buffer.dones[:38, 0].nonzero()[0], [6, 13, 20, 27, 34])


def test_a_copy_that_is_made_within_a_step_takes_another_environment():
    model, copies = make_model("n-step"), []

    def copy_elsewhere():
        copies.append(copy.deepcopy(model))
        copies[0].set_env(DummyVecEnv([Located]))

    model.learn(15, Do(9, copy_elsewhere))
    copies[0].learn(20, reset_num_timesteps=False)
    assert_no_episode_runs_into_another(copies[0].replay_buffer, n_steps=3)


class Leaving(TD3):
    """Says itself what a copy has."""

    scratch = None

    def __getstate__(self):
        return {name: value for name, value in vars(self).items() if name != "scratch"}


class GuardedLeaving(GuardedAlgorithm, Leaving):
    """Has the guards' attributes as well."""


def test_a_copy_lacks_what_the_algorithm_itself_leaves_out():
    model = GuardedLeaving("MlpPolicy", DummyVecEnv([Located]), **SMALL)
    model.scratch = [model]
    assert copy.deepcopy(model).scratch is None
