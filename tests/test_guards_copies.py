"""A copied model has a replay buffer of its own, and goes on where it was."""

import copy
import pickle

import numpy as np
import pytest
from guarded import IGNORED_WARNINGS, assert_no_episode_runs_into_another, make_model
from trainings import Do

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
