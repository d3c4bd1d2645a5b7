"""An environment that was reset, stepped or left by others than the training: no transition crosses the gap."""

import contextlib
import itertools

import numpy as np
import pytest
from guarded import (
    BUFFERS,
    IGNORED_WARNINGS,
    SMALL,
    GuardedTD3,
    Located,
    assert_no_episode_runs_into_another,
    located,
    make_model,
)
from stable_baselines3 import TD3
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.vec_env import VecNormalize
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer
from trainings import Do

pytestmark = IGNORED_WARNINGS


def learn_again(model, folder):
    return model.learn(20)


def learn_on_with_no_last_observation(model, folder):
    model._last_obs = None
    return model.learn(20, reset_num_timesteps=False)


def set_env(model, folder):
    model.set_env(located(model.n_envs, goals=isinstance(model.replay_buffer, HerReplayBuffer)))
    return model.learn(20, reset_num_timesteps=False)


def set_env_again(model, folder):
    model.set_env(model.get_env())
    return model.learn(20, reset_num_timesteps=False)


def set_env_without_a_reset(model, folder):
    env = located(model.n_envs, goals=isinstance(model.replay_buffer, HerReplayBuffer))
    env.reset()
    model.set_env(env, force_reset=False)
    return model.learn(20, reset_num_timesteps=False)


def reload(model, folder):
    model.save(folder / "model")
    model.save_replay_buffer(folder / "buffer")
    env = located(model.n_envs, goals=isinstance(model.replay_buffer, HerReplayBuffer))
    loaded = GuardedTD3.load(folder / "model", env)
    loaded.load_replay_buffer(folder / "buffer", truncate_last_traj=False)
    return loaded.learn(20, reset_num_timesteps=False)


def load_an_older_buffer(model, folder):
    model.save_replay_buffer(folder / "buffer")
    model.learn(11, reset_num_timesteps=False)
    if isinstance(model.replay_buffer, HerReplayBuffer):
        # SB3 has its buffer's environment set once
        model.replay_buffer.env = None
    model.load_replay_buffer(folder / "buffer", truncate_last_traj=False)
    return model.learn(20, reset_num_timesteps=False)


def interrupted_by(function):
    def interrupt(model, folder):
        with contextlib.suppress(KeyboardInterrupt):
            model.learn(20, Do(4, lambda: function(model)), reset_num_timesteps=False)
        return model.learn(20, reset_num_timesteps=False)

    return interrupt


def press_ctrl_c(model):
    raise KeyboardInterrupt


def fail_in_the_next_step(model):
    env = model.get_env()
    step_wait = env.step_wait

    def fail():
        env.step_wait = step_wait
        step_wait()
        raise KeyboardInterrupt

    env.step_wait = fail


def stopped_by_a_callback(model, folder):
    class Stop(Do):
        def _on_step(self):
            return self.n_calls < self.step

    model.learn(20, Stop(4, None), reset_num_timesteps=False)
    return model.learn(20, reset_num_timesteps=False)


def evaluated_between(model, folder):
    evaluate_policy(model, model.get_env(), n_eval_episodes=1)
    return model.learn(20, reset_num_timesteps=False)


def stepped_between(model, folder):
    model.get_env().step(np.zeros((model.n_envs, 1)))
    return model.learn(20, reset_num_timesteps=False)


def reset_between(model, folder):
    model.get_env().reset()
    return model.learn(20, reset_num_timesteps=False)


WAYS = [
    learn_again,
    learn_on_with_no_last_observation,
    set_env,
    set_env_again,
    set_env_without_a_reset,
    reload,
    load_an_older_buffer,
    interrupted_by(press_ctrl_c),
    interrupted_by(fail_in_the_next_step),
    stopped_by_a_callback,
    evaluated_between,
    stepped_between,
    reset_between,
]
NAMES = [
    *(way.__name__ for way in WAYS[:7]),
    "interrupted in a callback",
    "interrupted in a step",
    *(w.__name__ for w in WAYS[9:]),
]


@pytest.mark.parametrize("kind", BUFFERS)
@pytest.mark.parametrize("way", WAYS, ids=NAMES)
@pytest.mark.parametrize("n_envs", [1, 2])
def test_no_transition_runs_from_an_episode_into_the_next(kind, way, n_envs, tmp_path):
    model = make_model(kind, n_envs)
    model.learn(18)
    model = way(model, tmp_path)
    assert_no_episode_runs_into_another(model.replay_buffer, n_steps=model.n_steps)


@pytest.mark.parametrize("kind", BUFFERS)
@pytest.mark.parametrize("buffer_size", [15, 18, 21])
def test_no_transition_crosses_where_the_ring_begins_anew(kind, buffer_size, tmp_path):
    for steps in (buffer_size, buffer_size + 4):
        # Whole, or wrapped around; episodes of 7 steps are shorter
        model = make_model(kind, buffer_size=buffer_size)
        model.learn(steps)
        assert model.replay_buffer.full
        model.learn(4)
        assert_no_episode_runs_into_another(model.replay_buffer, n_steps=model.n_steps)


def test_sb3_itself_lets_returns_run_into_the_next_episode():
    """The oracle sees the fault where it is."""
    model = TD3("MlpPolicy", located(), n_steps=3, **SMALL)
    model.learn(18)
    model.learn(20)
    with pytest.raises(AssertionError):
        assert_no_episode_runs_into_another(model.replay_buffer, n_steps=3)


@pytest.mark.parametrize("kind", BUFFERS)
@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("normalises", [False, True])
def test_a_training_in_two_parts_is_the_same_as_in_one(kind, n_envs, normalises, monkeypatch):
    """An episode that goes on is not ended."""
    buffers = []
    for parts in ([40], [18, 22]):
        monkeypatch.setattr(Located, "numbers", itertools.count())
        env = located(n_envs, goals=kind == "hindsight")
        model = make_model(kind, env=VecNormalize(env) if normalises else env, learning_starts=100)
        for part in parts:
            model.learn(part, reset_num_timesteps=False)
        buffers.append(model.replay_buffer)
    for name in ("rewards", "dones", "timeouts", "actions"):
        np.testing.assert_array_equal(*(getattr(buffer, name) for buffer in buffers), err_msg=name)
    assert buffers[0].dones.sum() == 40 // n_envs // 7 * n_envs


class Correlated(OrnsteinUhlenbeckActionNoise):
    """Counts how often an episode of it begins."""

    n_episodes = 0

    def reset(self):
        super().reset()
        self.n_episodes += 1


def test_noise_begins_anew_with_an_episode_that_begins_because_the_environment_was_moved():
    noise = Correlated(np.zeros(1), np.ones(1))
    model = make_model("plain", action_noise=noise)
    noise.n_episodes = 0
    model.learn(6, Do(3, lambda: model.get_env().reset()))
    # At the start of the training, and after the reset; none of the episodes of 7 steps ends
    assert noise.n_episodes == 2


def test_each_training_says_anew_that_its_environment_was_moved():
    model = make_model("plain")
    for _ in range(2):
        with pytest.warns(UserWarning, match="was reset or stepped outside of this training") as warned:
            model.learn(6, [Do(step, lambda: model.get_env().reset()) for step in (2, 4)], reset_num_timesteps=False)
        assert len([each for each in warned if "outside of this training" in str(each.message)]) == 1
