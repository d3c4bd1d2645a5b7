"""A training that ends before the first gradient step says so, and no other does."""

import warnings

import pytest
from guarded import SMALL, GuardedTD3, located

from sb3_cgp.resumption.algorithm import resumable
from sb3_cgp.resumption.callbacks import TrainingCheckpointCallback


@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("train_freq", [1, 4, (1, "episode"), (2, "episode")], ids=str)
@pytest.mark.parametrize("gradient_steps", [1, -1])
@pytest.mark.parametrize("learning_starts", [0, 9, 12, 20])
@pytest.mark.parametrize("first_steps", [0, 4])
def test_a_training_without_a_gradient_step_warns_and_no_other_does(
    n_envs, train_freq, gradient_steps, learning_starts, first_steps
):
    if n_envs > 1 and isinstance(train_freq, tuple):
        return
    arguments = SMALL | dict(train_freq=train_freq, gradient_steps=gradient_steps, learning_starts=learning_starts)
    model = GuardedTD3("MlpPolicy", located(n_envs, length=5), **arguments)
    for total_timesteps in (first_steps, 8, 2) if first_steps else (9,):
        updates = model._n_updates
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            model.learn(total_timesteps, reset_num_timesteps=False)
        assert len(warned) == (model._n_updates == updates)
        if warned:
            message = str(warned[0].message)
            assert f"ends at environment step {model.num_timesteps}, " in message
            assert f"after step learning_starts={learning_starts}" in message


@pytest.mark.filterwarnings("error")
def test_a_training_that_is_not_to_learn_or_to_step_is_not_warned_of():
    GuardedTD3("MlpPolicy", located(), **(SMALL | dict(gradient_steps=0))).learn(5)
    GuardedTD3("MlpPolicy", located(), **SMALL).learn(0)


@pytest.mark.parametrize(("stop", "n_warnings"), [(8, 1), (18, 0), (30, 0)])
@pytest.mark.filterwarnings("ignore:The environment's state was not saved")
def test_a_resumed_training_is_judged_by_the_steps_that_are_left(stop, n_warnings, tmp_path):
    """Of 30 steps: all of those that are left are random, some are, or none is left."""
    algorithm = resumable(GuardedTD3)
    arguments = SMALL | dict(learning_starts=30 if n_warnings else 20, gradient_steps=1)
    model = algorithm("MlpPolicy", located(length=5), **arguments)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model.learn(stop, TrainingCheckpointCallback(2, tmp_path))
    resumed = algorithm.resume(tmp_path, located(length=5))
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        resumed.learn(30, TrainingCheckpointCallback(2, tmp_path))
    assert resumed.num_timesteps == 30
    assert len([each for each in warned if "Nothing is learnt" in str(each.message)]) == n_warnings
