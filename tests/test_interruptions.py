"""What an interruption or an error leaves as it was, in a process that goes on: a notebook, or a script that catches it."""

import os
import signal

import gymnasium as gym
import numpy as np
import pytest
from small_models import make_model, same_parameters
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize
from trainings import interrupted

from sb3_cgp import CEM, CGP
from sb3_cgp.resumption import TrainingCheckpointCallback
from sb3_cgp.resumption.locks import FolderLock


class Interrupted(CEM):
    """Is interrupted in one of its searches, as trainings are, which spend most of their time in CEM."""

    def select(self, *args, **kwargs):
        self.left -= 1
        if self.left == 0:
            raise KeyboardInterrupt
        return super().select(*args, **kwargs)


@pytest.mark.parametrize("inference", ["actor", "averaged_actor"])
# Of a step's three: for acting, for bootstrapping, and in the policy's loss
@pytest.mark.parametrize("search", [60, 61, 62])
def test_predict_asks_the_actor_after_an_interruption_within_cem(inference, search):
    selector = Interrupted(samples=8, elites=2)
    selector.left = search
    defaults = dict(cem_samples=64, cem_elites=6)
    model = make_model(inference=inference, policy_kwargs=dict(net_arch=[16], selector=selector), **defaults)
    with pytest.raises(KeyboardInterrupt):
        model.learn(100)
    assert model.policy.inference == inference
    observation = model.observation_space.sample()
    assert model.predict(observation)[0] == model.predict(observation)[0]


def test_a_folder_is_free_after_a_resumption_that_was_refused(tmp_path):
    interrupted(tmp_path)
    with pytest.raises(ValueError, match=r"`env\.num_envs` is 3") as refused:
        CGP.resume(tmp_path / "state", make_vec_env("Pendulum-v1", n_envs=3))
    # A notebook keeps the last error, and with it all that its frames hold
    lock = FolderLock(tmp_path / "state")
    lock.acquire()
    lock.release()
    assert refused.tb is not None


class Opaque(gym.Wrapper):
    """A wrapper of somebody's own, which may do anything."""


@pytest.mark.filterwarnings("ignore:The environment's state cannot be saved", "ignore:The state of .*EvalCallback")
def test_statistics_are_resumed_where_the_environment_is_not(tmp_path):
    training = interrupted(tmp_path, env=lambda: Opaque(gym.make("Pendulum-v1")), normalises=True)
    env = training.make_env(5)
    model = CGP.resume(tmp_path / "state", env)
    assert model.num_timesteps == 40
    with pytest.warns(UserWarning, match="The environment's state was not saved"):
        training.learn(model, None)
    # Of the 40 steps that were saved, of the 80 after them, and of the resets
    assert isinstance(env, VecNormalize)
    assert env.obs_rms.count == pytest.approx(40 + 80, abs=10)
    assert np.all(env.obs_rms.var > 0)


class StopAtOnce(BaseCallback):
    """Is told to end before the first step, as a job whose time is over when it begins."""

    def _on_training_start(self):
        os.kill(os.getpid(), signal.SIGTERM)

    def _on_step(self):
        return True


def test_a_training_that_is_stopped_before_its_first_step_is_resumed_from_there(tmp_path, handler):
    arguments = dict(learning_starts=5, batch_size=4)
    with pytest.raises(SystemExit):
        make_model(**arguments).learn(20, [TrainingCheckpointCallback(10, tmp_path / "state"), StopAtOnce()])
    model = CGP.resume(tmp_path / "state", "Pendulum-v1")
    assert model.num_timesteps == 0
    assert same_parameters(model.learn(20), make_model(**arguments).learn(20))
