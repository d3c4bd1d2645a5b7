"""Replay buffers of users' own classes, which store in their own way, are trained on as SB3's TD3 trains on them."""

import numpy as np
import pytest
import torch as th
from environments import Doubles
from guarded import IGNORED_WARNINGS, Located, located
from gymnasium import spaces
from stable_baselines3 import TD3
from stable_baselines3.common.buffers import BaseBuffer, ReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_cgp import CGP, TrainingCheckpointCallback

pytestmark = IGNORED_WARNINGS

SMALL = dict(learning_starts=6, batch_size=8, buffer_size=1000, policy_kwargs=dict(net_arch=[4]), seed=0, device="cpu")


class Bytes(ReplayBuffer):
    """Stores observations as integers."""

    def __init__(self, buffer_size, observation_space, *args, **kwargs):
        super().__init__(buffer_size, spaces.Box(0, 255, observation_space.shape, np.uint8), *args, **kwargs)


class Augmented(ReplayBuffer):
    """Stores observations with a further number."""

    def __init__(self, buffer_size, observation_space, *args, **kwargs):
        shape = (observation_space.shape[0] + 1,)
        super().__init__(buffer_size, spaces.Box(-np.inf, np.inf, shape), *args, **kwargs)

    def add(self, obs, next_obs, *args):
        super().add(*(np.pad(each, ((0, 0), (0, 1))) for each in (obs, next_obs)), *args)

    def _get_samples(self, *args, **kwargs):
        batch = super()._get_samples(*args, **kwargs)
        names = ("observations", "next_observations")
        return batch._replace(**{name: getattr(batch, name)[:, :-1] for name in names})


class OneStream(ReplayBuffer):
    """Stores the transitions of all environments as those of one."""

    def __init__(self, buffer_size, observation_space, action_space, device="cpu", n_envs=1, **kwargs):
        super().__init__(buffer_size, observation_space, action_space, device, n_envs=1, **kwargs)

    def add(self, *transitions):
        for row in range(len(transitions[0])):
            super().add(*(each[row : row + 1] for each in transitions))


class UnitActions(ReplayBuffer):
    """Stores actions as those of a space of its own."""

    def __init__(self, buffer_size, observation_space, action_space, *args, **kwargs):
        super().__init__(buffer_size, observation_space, spaces.Box(-3, 3, action_space.shape), *args, **kwargs)


class Rows(ReplayBuffer):
    """Has arrays or tensors of its own under SB3's names, and a constructor of its own."""

    width, flag = None, np.float32

    def __init__(self, buffer_size, observation_space, action_space, device="cpu", n_envs=1, **kwargs):
        BaseBuffer.__init__(self, buffer_size, observation_space, action_space, device, n_envs)
        self.handle_timeout_termination = True
        self.width = self.width or self.obs_shape[0]
        rows = (self.buffer_size, n_envs)
        self.observations, self.next_observations = (np.zeros((*rows, self.width), np.float32) for _ in range(2))
        self.actions, self.rewards = np.zeros((*rows, self.action_dim), np.float32), np.zeros(rows, np.float32)
        self.dones, self.timeouts = np.zeros(rows, self.flag), np.zeros(rows, self.flag)

    def add(self, obs, next_obs, action, reward, done, infos):
        fields = ("observations", "next_observations", "actions", "rewards", "dones")
        rows = (obs[:, : self.width], next_obs[:, : self.width], action, reward, done)
        for name, row in zip(fields, rows, strict=True):
            field = getattr(self, name)
            field[self.pos] = th.as_tensor(row) if isinstance(field, th.Tensor) else row
        self.pos += 1

    def sample(self, batch_size, env=None):
        return BaseBuffer.sample(self, batch_size, env)

    def _get_samples(self, batch_inds, env=None):
        fields = (self.observations, self.actions, self.next_observations, self.dones, self.rewards)
        observations, actions, following, dones, rewards = (th.as_tensor(each[batch_inds]).float() for each in fields)
        repeats = (1, self.obs_shape[0] // self.width)
        return ReplayBufferSamples(
            observations[:, 0].repeat(repeats), actions[:, 0], following[:, 0].repeat(repeats), dones, rewards
        )


class Narrow(Rows):
    """Stores a part of each observation."""

    width = 1


class Flags(Rows):
    """Stores tensors, and ends of episodes as truth values."""

    flag = bool

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        for name, value in vars(self).items():
            if isinstance(value, np.ndarray):
                setattr(self, name, th.as_tensor(value))


@pytest.mark.parametrize("buffer_class", [Bytes, Augmented, OneStream, UnitActions, Rows, Narrow, Flags])
@pytest.mark.parametrize("algorithm", [TD3, CGP])
def test_a_buffer_that_stores_in_its_own_way_is_trained_on(algorithm, buffer_class, tmp_path):
    n_envs = 2 if buffer_class is OneStream else 1
    model = algorithm("MlpPolicy", located(n_envs), replay_buffer_class=buffer_class, **SMALL).learn(20)
    buffer = model.replay_buffer
    model.learn(20).learn(20, reset_num_timesteps=False)
    assert model.replay_buffer is buffer
    assert buffer.size() == (60 if buffer_class is OneStream else 60 // n_envs)
    if buffer_class not in (Rows, Narrow, Flags):
        # SB3 cannot pickle what it does not find in these
        model.save_replay_buffer(tmp_path / "buffer")
        model.load_replay_buffer(tmp_path / "buffer")
        model.learn(20)


@pytest.mark.parametrize("buffer_class", [Bytes, Augmented, UnitActions, Rows, Narrow, Flags])
def test_a_training_on_such_a_buffer_is_resumed_to_the_bit(buffer_class, tmp_path):
    def train(steps, folder, model):
        return model.learn(steps, TrainingCheckpointCallback(10, tmp_path / folder))

    def make():
        return make_vec_env("Pendulum-v1", 1, seed=3)

    arguments = SMALL | dict(replay_buffer_class=buffer_class)
    expected = train(60, "straight", CGP("MlpPolicy", make(), **arguments))
    train(40, "state", CGP("MlpPolicy", make(), **arguments))
    resumed = train(60, "state", CGP.resume(tmp_path / "state", make()))
    for name, value in expected.policy.state_dict().items():
        assert th.equal(resumed.policy.state_dict()[name], value), name


class Wide(Doubles):
    """Observes in float64, as MuJoCo's tasks do."""

    observation_space = spaces.Box(-np.inf, np.inf, (3,), np.float64)


class Counting(ReplayBuffer):
    n_samples = 0

    def sample(self, *args, **kwargs):
        self.n_samples += 1
        return super().sample(*args, **kwargs)


@pytest.mark.parametrize("buffer_class", [ReplayBuffer, Counting])
@pytest.mark.parametrize("algorithm", [TD3, CGP])
def test_an_empty_buffer_that_was_put_in_place_is_filled(algorithm, buffer_class):
    model = algorithm("MlpPolicy", DummyVecEnv([Wide]), **SMALL)
    buffer = model.replay_buffer = buffer_class(100, model.observation_space, model.action_space, device="cpu")
    model.learn(20)
    assert model.replay_buffer is buffer
    assert buffer.size() == 20
    assert getattr(buffer, "n_samples", 14) == 14


def test_a_class_with_a_data_type_of_its_own_is_not_replaced():
    class Halves(ReplayBuffer):
        def __init__(self, buffer_size, observation_space, *args, **kwargs):
            super().__init__(buffer_size, spaces.Box(-np.inf, np.inf, observation_space.shape, np.float16), *args, **kwargs)

    model = CGP("MlpPolicy", DummyVecEnv([Wide]), replay_buffer_class=Halves, **SMALL)
    model.replay_buffer.note = "mine"
    assert model.learn(5).replay_buffer.note == "mine"
    model.set_env(VecNormalize(DummyVecEnv([Wide])))
    assert model.learn(5).replay_buffer.note == "mine"


def test_an_own_buffer_for_dict_observations_may_return_several_steps():
    class Several(ReplayBuffer):
        def __init__(self, buffer_size, observation_space, *args, **kwargs):
            super().__init__(buffer_size, observation_space["observation"], *args, **kwargs)

        def add(self, obs, next_obs, *args):
            super().add(obs["observation"], next_obs["observation"], *args)

        def _get_samples(self, *args, **kwargs):
            batch = super()._get_samples(*args, **kwargs)
            names = ("observations", "next_observations")
            return batch._replace(**{name: dict.fromkeys(self.keys, getattr(batch, name)) for name in names})

        keys = ("observation", "achieved_goal", "desired_goal")

    arguments = SMALL | dict(replay_buffer_class=Several, n_steps=3)
    with pytest.warns(UserWarning, match="n_steps"):
        model = CGP("MultiInputPolicy", DummyVecEnv([lambda: Located(goals=True)]), **arguments)
    assert model.learn(20).learn(20, reset_num_timesteps=False)._n_updates == 34
    with pytest.raises(ValueError, match="`n_steps` is 3, but must be 1 with a Dict observation space"):
        CGP("MultiInputPolicy", DummyVecEnv([lambda: Located(goals=True)]), **SMALL, n_steps=3)


class Plain(ReplayBuffer):
    """A user's own class that stores as SB3's does."""


@pytest.mark.parametrize("buffer_class", [ReplayBuffer, Plain, Counting])
def test_a_class_that_stores_as_sb3s_is_checked_as_sb3s(buffer_class, tmp_path):
    def make(n_envs=1, high=1.0):
        envs = located(n_envs)
        envs.action_space = spaces.Box(-high, high, (1,), np.float32)
        return CGP("MlpPolicy", envs, replay_buffer_class=buffer_class, **SMALL)

    model = make().learn(20)
    model.save_replay_buffer(tmp_path / "buffer")
    for other, name in ((make(n_envs=2), "n_envs"), (make(high=2.0), "action_space")):
        kept = other.replay_buffer
        with pytest.raises(ValueError, match=rf"`replay_buffer.{name}`"):
            other.load_replay_buffer(tmp_path / "buffer")
        assert other.replay_buffer is kept
    model.replay_buffer.actions[3] = 7.0
    with pytest.raises(ValueError, match=r"`replay_buffer.actions\[3\]` is 7.0, but must be scaled"):
        model.learn(20)


@pytest.mark.parametrize("buffer_class", [ReplayBuffer, Plain, Counting])
def test_such_a_class_stores_what_is_normalised_as_it_is(buffer_class):
    model = CGP("MlpPolicy", DummyVecEnv([Wide]), replay_buffer_class=buffer_class, **SMALL)
    model.set_env(VecNormalize(DummyVecEnv([Wide])))
    assert model.learn(5).replay_buffer.observations.dtype == np.float64
    model = CGP("MlpPolicy", DummyVecEnv([Wide]), replay_buffer_class=buffer_class, **SMALL).learn(5)
    model.set_env(VecNormalize(DummyVecEnv([Wide])))
    with pytest.warns(UserWarning, match="The replay buffer stores observations in float32"):
        model.learn(5)


@pytest.mark.parametrize("algorithm", [TD3, CGP])
def test_an_own_buffer_may_mark_what_is_unknown_by_nan(algorithm):
    class Unknown(ReplayBuffer):
        def add(self, obs, next_obs, *args):
            super().add(obs, next_obs, *args)
            self.next_observations[self.pos - 1, :, 1] = np.nan

        def _get_samples(self, *args, **kwargs):
            batch = super()._get_samples(*args, **kwargs)
            return batch._replace(next_observations=batch.next_observations.nan_to_num())

    model = algorithm("MlpPolicy", located(), replay_buffer_class=Unknown, **SMALL).learn(20)
    assert model.learn(20, reset_num_timesteps=False).replay_buffer.size() == 40
