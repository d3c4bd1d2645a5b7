"""A callback's environments, such as that of an evaluation, are saved with it, each once, and the training's own is not."""

import gymnasium as gym
import numpy as np
import pytest
from environments import Doubles, Reach
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

from sb3_cgp import CGP, TrainingCheckpointCallback

pytestmark = pytest.mark.usefixtures("short_episodes")

TINY = dict(learning_starts=5, batch_size=4, buffer_size=300, policy_kwargs=dict(net_arch=[4]), device="cpu", seed=0)


class Stepping(BaseCallback):
    """Steps an environment that is not vectorised, such as one for an evaluation of its own."""

    def __init__(self, env):
        super().__init__()
        self.env, self.seen = env, []

    def _on_training_start(self):
        self.env.reset(seed=self.model.seed)

    def _on_step(self):
        observation, *_, truncated, _ = self.env.step(self.env.action_space.sample())
        self.seen.append(observation if not truncated else self.env.reset()[0])
        return True


def test_an_environment_that_is_not_vectorised_is_saved_with_its_callback(tmp_path):
    def train(model, steps, folder):
        callback = Stepping(gym.make("Pendulum-v1"))
        callback.env.action_space.seed(model.num_timesteps)
        model.learn(steps, [callback, TrainingCheckpointCallback(10, folder)])
        return callback.seen

    expected = train(CGP("MlpPolicy", "Pendulum-v1", **TINY), 70, tmp_path / "straight")
    train(CGP("MlpPolicy", "Pendulum-v1", **TINY), 40, tmp_path / "state")
    np.testing.assert_array_equal(train(CGP.resume(tmp_path / "state", "Pendulum-v1"), 70, tmp_path / "state"), expected)
    callbacks = [Stepping(Doubles()), TrainingCheckpointCallback(10, tmp_path / "other")]
    with pytest.warns(UserWarning, match=r"The state of Stepping's `env` cannot be saved: .*Doubles is unknown"):
        CGP("MlpPolicy", "Pendulum-v1", **TINY).learn(20, callbacks)
    with pytest.warns(UserWarning, match="Stepping's `env` was not saved: its episodes will be other ones"):
        CGP.resume(tmp_path / "other", "Pendulum-v1").learn(30, Stepping(Doubles()))


@pytest.mark.parametrize(
    "inner",
    [lambda env: env.venv, lambda env: env.venv.envs[0], lambda env: env.venv.envs[0].unwrapped],
    ids=["vectorised", "outermost", "unwrapped"],
)
def test_the_trainings_own_environment_is_not_saved_with_a_callback(inner, tmp_path):
    class Looking(BaseCallback):
        def _on_step(self):
            self.env = inner(self.training_env)
            return True

    env = VecMonitor(DummyVecEnv([lambda: Monitor(Doubles())]))
    with pytest.warns(UserWarning, match="cannot be saved") as warned:
        CGP("MlpPolicy", env, **TINY).learn(20, [Looking(), TrainingCheckpointCallback(10, tmp_path)])
    assert [str(each.message) for each in warned if "Looking" in str(each.message)] == []


def test_the_state_of_each_environment_is_computed_once_for_a_state_of_the_training(tmp_path, monkeypatch):
    calls = []
    monkeypatch.setattr(Reach, "get_training_state", lambda self: calls.append(id(self)) or {"place": 0.0})
    training, evaluation = (DummyVecEnv([Reach]) for _ in range(2))
    callbacks = [EvalCallback(evaluation, eval_freq=99, verbose=0), TrainingCheckpointCallback(10, tmp_path / "state")]
    CGP("MultiInputPolicy", training, **TINY).learn(20, callbacks)
    # A state after 10 steps, and one at the end
    assert sorted(calls) == sorted([id(training.envs[0]), id(evaluation.envs[0])] * 2)


def test_another_evaluation_environment_is_warned_of_by_its_callback(tmp_path):
    def evaluation(n_envs):
        return EvalCallback(make_vec_env("Pendulum-v1", n_envs), eval_freq=15, n_eval_episodes=2, verbose=0)

    CGP("MlpPolicy", "Pendulum-v1", **TINY).learn(20, [evaluation(1), TrainingCheckpointCallback(10, tmp_path / "state")])
    other = evaluation(2)
    with pytest.warns(UserWarning, match=r"EvalCallback's `eval_env` is not the saved one, .*'2 x .*'1 x"):
        CGP.resume(tmp_path / "state", "Pendulum-v1").learn(40, other)
    assert other.n_calls == 40
