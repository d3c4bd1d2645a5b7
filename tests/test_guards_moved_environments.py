"""An environment that a callback, another training or an evaluation moves during a training."""

import warnings

import numpy as np
import pytest
from guarded import IGNORED_WARNINGS, SMALL, GuardedTD3, Located, assert_no_episode_runs_into_another, located, make_model
from gymnasium.wrappers import TimeLimit
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize
from trainings import Do

pytestmark = IGNORED_WARNINGS


@pytest.mark.parametrize(
    "vec_env", [DummyVecEnv, lambda fns: SubprocVecEnv(fns, start_method="fork")], ids=["here", "workers"]
)
@pytest.mark.parametrize("normalises", [False, True])
@pytest.mark.parametrize("what", ["nested training", "evaluation", "reset"])
def test_an_environment_that_a_callback_moves_begins_an_episode(vec_env, normalises, what):
    env = vec_env([Located, Located])
    env = VecNormalize(env, norm_obs=False) if normalises else env
    model = make_model("n-step", env=env)

    def move():
        if what == "nested training":
            GuardedTD3("MlpPolicy", env, **SMALL).learn(16)
        elif what == "evaluation":
            evaluate_policy(model, env, n_eval_episodes=1)
        else:
            env.reset()

    with pytest.warns(UserWarning, match="was reset or stepped outside of this training, at environment step 16") as warned:
        model.learn(40, [Do(8, move), Do(14, move)])
    # Each training is told once
    assert len([each for each in warned if "outside of this training" in str(each.message)]) == 1
    assert model.num_timesteps == 40
    assert "_save_obs" not in vars(env.unwrapped)
    assert_no_episode_runs_into_another(model.replay_buffer, n_steps=3)
    # The step in which the callback moved it was made too
    observations = model.replay_buffer.observations[:20]
    assert np.all(model.replay_buffer.next_observations[:20, :, 1] == observations[:, :, 1] + 1)
    env.close()


@pytest.mark.parametrize("index", [0, 1, 2])
@pytest.mark.parametrize("when", ["step", "reset"])
def test_replies_of_workers_that_an_interruption_left_unread_are_not_taken_for_others(index, when):
    env = SubprocVecEnv([Located] * 3, start_method="fork")
    model = make_model("n-step", env=env).learn(18)
    remote = env.remotes[index]

    def fail():
        del remote.recv
        raise KeyboardInterrupt

    def interrupt():
        remote.recv = fail

    if when == "step":
        with pytest.raises(KeyboardInterrupt):
            model.learn(30, Do(4, interrupt), reset_num_timesteps=False)
    else:
        interrupt()
        with pytest.raises(KeyboardInterrupt):
            env.reset()
    model.learn(30, reset_num_timesteps=False)
    model.learn(30)
    assert_no_episode_runs_into_another(model.replay_buffer, n_steps=3)
    env.close()


def interrupt():
    raise KeyboardInterrupt


@pytest.mark.parametrize("what", ["Ctrl-C", "step", "new training", "learn"])
def test_a_monitor_that_refuses_early_resets_is_told_why_and_what_to_do(what):
    env = DummyVecEnv([lambda: Monitor(Located(), allow_early_resets=False)])
    model = GuardedTD3("MlpPolicy", env, **SMALL)
    reasons = {
        "Ctrl-C": "its last step was interrupted before it was stored",
        "step": "it was reset or stepped outside of this training",
        "learn": "it was reset or stepped outside of this training",
        "new training": "a training that begins",
    }
    if what == "Ctrl-C":
        with pytest.raises(KeyboardInterrupt):
            model.learn(30, Do(10, interrupt))
    else:
        model.learn(10)
    if what == "step":
        env.step(np.zeros((1, 1)))
    # In the middle of a training, or at its start
    callback = Do(2, lambda: env.step(np.zeros((1, 1)))) if what == "learn" else None
    message = rf"reset in the middle of an episode: {reasons[what]}.*`Monitor\(env, allow_early_resets=True\)`, or .*`set_env`"
    with pytest.raises(RuntimeError, match=message):
        model.learn(10, callback, reset_num_timesteps=what == "new training")
    n_before = model.num_timesteps
    model.set_env(Monitor(Located(), allow_early_resets=False))
    assert model.learn(7, reset_num_timesteps=False).num_timesteps == n_before + 7


def test_another_error_of_a_reset_reaches_the_user_unchanged():
    env = Located()
    model = GuardedTD3("MlpPolicy", Monitor(env), **SMALL).learn(10)

    def fail(**kwargs):
        raise RuntimeError("the robot does not answer")

    env.reset = fail
    with pytest.raises(RuntimeError, match=r"^the robot does not answer$"):
        model.learn(10)


def test_nested_trainings_leave_the_environment_as_it_was():
    env = located()
    inner = make_model("plain", env=env)
    outer = make_model("plain", env=env)
    outer.learn(15, Do(5, lambda: inner.learn(10, Do(5, lambda: make_model("plain", env=env).learn(9)))))
    assert "_save_obs" not in vars(env)
    assert "reset" not in vars(env.envs[0])
    for model in (outer, inner):
        assert_no_episode_runs_into_another(model.replay_buffer)


@pytest.mark.parametrize("within", ["Monitor", "TimeLimit"])
@pytest.mark.parametrize("when", ["between", "in a callback"])
def test_an_environment_that_is_shared_with_an_evaluation_is_noticed(within, when):
    env = Monitor(Located(50)) if within == "Monitor" else TimeLimit(Located(50), 20)
    model = make_model("n-step", env=env)
    # In a vectorised environment of its own
    evaluation = DummyVecEnv([lambda: env])
    if when == "between":
        model.learn(15)
        evaluate_policy(model, evaluation, n_eval_episodes=1, warn=False)
        model.learn(15, reset_num_timesteps=False)
    else:
        with pytest.warns(UserWarning, match="The training environment was reset or stepped outside of this training"):
            model.learn(30, callback=Do(15, lambda: evaluate_policy(model, evaluation, n_eval_episodes=1, warn=False)))
    assert_no_episode_runs_into_another(model.replay_buffer, n_steps=3)


def test_an_environment_that_a_callback_sets_within_a_step_is_refused():
    model = make_model("plain")
    with pytest.raises(RuntimeError, match="`set_env` was called by a callback in the middle of a step"):
        model.learn(30, callback=Do(15, lambda: model.set_env(located())))
    model.set_env(located())
    model.learn(20, reset_num_timesteps=False)
    assert np.isfinite(model.replay_buffer.observations).all()
    assert_no_episode_runs_into_another(model.replay_buffer)


@pytest.mark.parametrize("vec_env", [DummyVecEnv, lambda fns: SubprocVecEnv(fns, start_method="fork")])
def test_an_environment_that_a_callback_sets_between_rollouts_begins_an_episode(vec_env):
    class Setting(BaseCallback):
        def _on_rollout_end(self):
            if self.num_timesteps == 12:
                self.model.set_env(other)

        def _on_step(self):
            return True

    first, other = vec_env([Located]), vec_env([Located])
    model = make_model("n-step", env=first)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*outside of this training")
        model.learn(30, Setting())
    assert model.replay_buffer.dones[:12].nonzero()[0].tolist() == [6, 11]
    assert_no_episode_runs_into_another(model.replay_buffer, n_steps=3)
    first.close()
    other.close()


class Overflowing(Located):
    """Returns an infinite observation or reward at one of its steps, counted over all episodes."""

    def __init__(self, at, what):
        super().__init__()
        self.at, self.what, self.total = at, what, 0

    def step(self, action):
        self.total += 1
        observation, reward, *others = super().step(action)
        if self.total == self.at:
            observation, reward = (observation * np.inf, reward) if self.what == "observation" else (observation, np.inf)
        return observation, reward, *others


@pytest.mark.filterwarnings("ignore:invalid value encountered")
@pytest.mark.parametrize("what", ["observation", "reward"])
@pytest.mark.parametrize("move", ["reset", "step"])
@pytest.mark.parametrize("own", [True, False], ids=["training's step", "callback's step"])
def test_the_trainings_own_step_is_checked_and_stored_when_a_callback_moves_a_normalised_environment(what, move, own):
    env = VecNormalize(DummyVecEnv([lambda: Overflowing(10 if own else 11, what)]))

    def do():
        env.reset()
        if move == "step":
            env.step(np.zeros((1, 1)))

    model = make_model("plain", env=env)
    callback = Do(10, do)
    if own:
        with pytest.raises(ValueError, match=f"NaN or infinite .* {what} at environment step 10"):
            model.learn(10, callback)
        assert model.replay_buffer.size() == 9
    else:
        model.learn(10, callback)
        assert np.all(model.replay_buffer.next_observations[:10, :, 1] == model.replay_buffer.observations[:10, :, 1] + 1)
        assert np.all(model.replay_buffer.rewards[:10] == 1)


class Counting(Located):
    """Has a number of the user's, by the names of the counters of SB3's and Gymnasium's wrappers."""

    total_steps, _elapsed_steps, rewards = 0, 0, 0

    def set_progress(self, number):
        self.total_steps = self._elapsed_steps = self.rewards = number


class SetProgress(BaseCallback):
    """Tells the environment how far the training is, at every step."""

    def __init__(self, function):
        super().__init__()
        self.function = function

    def _on_step(self):
        self.function(self.training_env, self.num_timesteps)
        return True


@pytest.mark.filterwarnings("error:The training environment was reset or stepped")
@pytest.mark.parametrize(
    "wrap", [lambda env: env, Monitor, lambda env: TimeLimit(env, 20)], ids=["bare", "Monitor", "TimeLimit"]
)
@pytest.mark.parametrize(
    "function",
    [
        lambda env, number: env.env_method("set_progress", number),
        lambda env, number: env.set_attr("total_steps", 1000 - number),
    ],
    ids=["by a method", "by an attribute"],
)
def test_an_environment_whose_own_attributes_a_callback_sets_has_not_moved(wrap, function):
    model = make_model("n-step", env=DummyVecEnv([lambda: wrap(Counting())])).learn(40, SetProgress(function))
    assert model.replay_buffer.dones.sum() == 40 // 7
    assert_no_episode_runs_into_another(model.replay_buffer, n_steps=3)
