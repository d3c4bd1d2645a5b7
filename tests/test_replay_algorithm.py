"""The replay buffer: float32 in whichever of SB3's classes, and the same training as with float64."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from environments import Doubles
from gymnasium import spaces
from stable_baselines3 import TD3, HerReplayBuffer
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_cgp import CGP
from sb3_cgp.fast.replay_algorithm import float32_space

SMALL = dict(learning_starts=30, buffer_size=200, batch_size=8, cem_samples=8, cem_elites=2, seed=0, device="cpu")


class Goals(Doubles):
    """The same as a goal environment, with an image that is to stay as it is."""

    observation_space = spaces.Dict(
        observation=spaces.Box(-np.inf, np.inf, (3,), np.float64),
        achieved_goal=spaces.Box(-np.inf, np.inf, (3,), np.float64),
        desired_goal=spaces.Box(-np.inf, np.inf, (3,), np.float64),
        image=spaces.Box(0, 255, (3, 36, 36), np.uint8),
    )

    def observe(self):
        values = {key: super(Goals, self).observe() for key in ("observation", "achieved_goal", "desired_goal")}
        return values | {"image": np.zeros((3, 36, 36), np.uint8)}

    def compute_reward(self, achieved_goal, desired_goal, info):
        return -np.linalg.norm(achieved_goal - desired_goal, axis=-1)


def make_model(env, policy="MlpPolicy", **kwargs):
    return CGP(policy, env, policy_kwargs=dict(net_arch=[8]), **(SMALL | kwargs))


def parameters(model):
    return th.cat([parameter.flatten() for parameter in model.policy.parameters()])


def test_gradient_steps_without_data_are_refused_with_the_remedy(tmp_path):
    model = make_model("Pendulum-v1")
    model.save(tmp_path / "model")
    for each in (model, CGP.load(tmp_path / "model", "Pendulum-v1")):
        with pytest.raises(ValueError, match=r"`replay_buffer.size\(\)` is 0, but must be above 0: fill it by `learn`"):
            each.train(3)


def test_a_replay_of_mujoco_takes_half_the_memory_of_sb3s():
    def bytes_of(buffer):
        return buffer.observations.nbytes + buffer.next_observations.nbytes

    env = gym.make("HalfCheetah-v5")
    theirs = TD3("MlpPolicy", env, buffer_size=200).replay_buffer
    ours = make_model(env).replay_buffer
    assert type(ours) is type(theirs) is ReplayBuffer
    assert bytes_of(ours) * 2 == bytes_of(theirs)


VARIATIONS = {
    "plain": (dict(), ReplayBuffer),
    "n-step": (dict(n_steps=3), NStepReplayBuffer),
    "memory": (
        dict(optimize_memory_usage=True, replay_buffer_kwargs=dict(handle_timeout_termination=False)),
        ReplayBuffer,
    ),
}


@pytest.mark.parametrize("name", VARIATIONS)
def test_training_is_the_same_to_the_bit_as_on_float64(monkeypatch, name):
    kwargs, buffer_class = VARIATIONS[name]
    narrow = make_model(Doubles(), **kwargs).learn(80)
    monkeypatch.setattr("sb3_cgp.fast.replay_algorithm.float32_space", lambda space: space)
    wide = make_model(Doubles(), **kwargs).learn(80)
    assert narrow._n_updates == wide._n_updates == 50
    assert type(narrow.replay_buffer) is buffer_class
    assert (narrow.replay_buffer.observations.dtype, wide.replay_buffer.observations.dtype) == (np.float32, np.float64)
    assert th.equal(parameters(narrow), parameters(wide))


class FarFromZero(Doubles):
    """Observations near 1e6 that differ by less than float32 can tell apart."""

    def observe(self):
        return 1e6 + 0.01 * self.np_random.normal(size=3)


class FarGoals(gym.ObservationWrapper):
    """The same within a Dict."""

    def __init__(self):
        super().__init__(FarFromZero())
        self.observation_space = spaces.Dict(x=self.env.observation_space, y=spaces.Box(-1, 1, (1,), np.float32))

    def observation(self, observation):
        return dict(x=observation, y=np.zeros(1, np.float32))


@pytest.mark.parametrize("env_class", [FarFromZero, FarGoals])
def test_vec_normalize_normalises_what_was_observed_to_the_bit(env_class):
    env = VecNormalize(DummyVecEnv([env_class]), gamma=0.99, norm_obs_keys=["x"] if env_class is FarGoals else None)
    model = make_model(env, "MultiInputPolicy" if env_class is FarGoals else "MlpPolicy").learn(80)
    stored = model.replay_buffer.observations
    stored = stored["x"] if isinstance(stored, dict) else stored
    assert stored.dtype == np.float64
    # In float32 they would be a few multiples of 1/16
    assert len(np.unique(stored[:80])) == 240
    assert model._n_updates == 50
    rows = stored[:80, 0]
    normalised = env.normalize_obs(dict(x=rows, y=np.zeros((80, 1)))) if env_class is FarGoals else env.normalize_obs(rows)
    normalised = normalised["x"] if isinstance(normalised, dict) else normalised
    batch = model.replay_buffer.sample(32, env=env).observations
    batch = (batch["x"] if isinstance(batch, dict) else batch).numpy()
    assert all((normalised.astype(np.float32) == row).all(axis=1).any() for row in batch)


def test_normalisation_that_comes_when_there_are_rows_warns_of_what_they_have_lost():
    model = make_model(DummyVecEnv([FarFromZero])).learn(30)
    model.set_env(VecNormalize(DummyVecEnv([FarFromZero])))
    with pytest.warns(UserWarning, match="The replay buffer stores observations in float32, and `env` normalises them now"):
        model.learn(5)


def test_normalisation_that_comes_or_goes_later_is_stored_accordingly():
    plain, normalising = DummyVecEnv([FarFromZero]), VecNormalize(DummyVecEnv([FarFromZero]))
    rewards_only = VecNormalize(DummyVecEnv([FarFromZero]), norm_obs=False)
    model = make_model(plain)
    for env, dtype in ((normalising, np.float64), (rewards_only, np.float32), (plain, np.float32)):
        model = make_model(plain if env is normalising else normalising)
        model.set_env(env)
        model.learn(5)
        assert model.replay_buffer.observations.dtype == dtype


@pytest.mark.parametrize("buffer_class", [DictReplayBuffer, HerReplayBuffer])
def test_dict_and_hindsight_replay_narrow_what_is_float64_and_nothing_else(buffer_class):
    model = make_model(Goals(), "MultiInputPolicy", replay_buffer_class=buffer_class).learn(60)
    dtypes = {key: array.dtype for key, array in model.replay_buffer.observations.items()}
    assert dtypes.pop("image") == np.uint8
    assert set(dtypes.values()) == {np.dtype(np.float32)}
    assert model._n_updates == 30


class OrderedParts(Doubles):
    """Whose keys are not in alphabetical order."""

    observation_space = spaces.Dict(
        [("velocity", spaces.Box(-np.inf, np.inf, (2,), np.float64)), ("angle", spaces.Box(-np.inf, np.inf, (2,), np.float32))]
    )

    def observe(self):
        return {"velocity": self.np_random.normal(size=2), "angle": self.np_random.normal(size=2).astype(np.float32)}


def test_the_keys_of_observations_keep_their_order():
    """A features extractor may depend on it."""
    seen = []

    class Extractor(BaseFeaturesExtractor):
        def __init__(self, observation_space):
            super().__init__(observation_space, features_dim=4)

        def forward(self, observations):
            seen.append(tuple(observations))
            return th.cat(list(observations.values()), dim=1)

    kwargs = dict(net_arch=[8], features_extractor_class=Extractor)
    CGP("MultiInputPolicy", OrderedParts(), policy_kwargs=kwargs, **SMALL).learn(40)
    assert set(seen) == {("velocity", "angle")}
    assert list(float32_space(OrderedParts.observation_space)) == ["velocity", "angle"]


class Annealing(ReplayBuffer):
    """A buffer whose argument changes along the training, as that of a prioritised one."""

    def __init__(self, *args, beta, weights, **kwargs):
        super().__init__(*args, **kwargs)
        self.beta, self.weights = beta, weights

    def sample(self, *args, **kwargs):
        self.beta += 0.1
        return super().sample(*args, **kwargs)


def test_a_buffer_of_the_users_own_is_loaded_with_what_has_changed(tmp_path):
    arguments = dict(beta=0.4, weights=np.ones(3))
    model = make_model(Doubles(), replay_buffer_class=Annealing, replay_buffer_kwargs=arguments).learn(40)
    beta = model.replay_buffer.beta
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = CGP.load(tmp_path / "model", env=Doubles())
    loaded.load_replay_buffer(tmp_path / "buffer")
    assert loaded.replay_buffer.beta == beta > 0.4


def test_the_strategy_of_hindsight_may_be_written_in_any_case(tmp_path):
    kwargs = dict(goal_selection_strategy="Future")
    model = make_model(Goals(), "MultiInputPolicy", replay_buffer_class=HerReplayBuffer, replay_buffer_kwargs=kwargs)
    model.learn(40).save_replay_buffer(tmp_path / "buffer")
    model.load_replay_buffer(tmp_path / "buffer")


def test_a_loaded_buffer_of_other_bounds_is_not_taken_for_one_that_is_normalised_now(tmp_path):
    class Bounded(Doubles):
        def __init__(self, bound):
            self.observation_space = spaces.Box(-bound, bound, (3,), np.float32)

        def observe(self):
            return np.zeros(3, np.float32)

    make_model(Bounded(1)).learn(40).save_replay_buffer(tmp_path / "buffer")
    model = make_model(Bounded(2))
    model.load_replay_buffer(tmp_path / "buffer")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.learn(40)


def test_the_buffer_is_sb3s_own_for_whoever_loads_it(tmp_path):
    env = Doubles()
    make_model(env).learn(60).save_replay_buffer(tmp_path / "buffer")
    td3 = TD3("MlpPolicy", env, learning_starts=0, seed=0)
    td3.load_replay_buffer(tmp_path / "buffer")
    assert td3.replay_buffer.size() == 60
    td3.learn(10)


@pytest.mark.parametrize("algorithm", [TD3, CGP])
def test_a_buffer_that_is_there_before_the_networks_is_kept(tmp_path, algorithm):
    class WithBuffer(algorithm):
        def _setup_model(self):
            self.replay_buffer = ReplayBuffer(77, self.observation_space, self.action_space)
            super()._setup_model()

    arguments = dict(learning_starts=30, buffer_size=200, policy_kwargs=dict(net_arch=[8]))
    assert WithBuffer("MlpPolicy", Doubles(), **arguments).replay_buffer.buffer_size == 77
    model = algorithm("MlpPolicy", Doubles(), **arguments).learn(40)
    model.save(tmp_path / "model", include=["replay_buffer"])
    loaded = algorithm.load(tmp_path / "model", env=Doubles())
    assert loaded.learn(5, reset_num_timesteps=False).replay_buffer.size() == 45
    loaded = algorithm.load(tmp_path / "model", env=Doubles(), replay_buffer=model.replay_buffer)
    assert loaded.replay_buffer is model.replay_buffer


def test_a_buffer_that_was_saved_within_a_model_is_checked_and_moved_to_its_device(tmp_path):
    model = make_model(Doubles()).learn(40)
    model.replay_buffer.device = th.device("meta")
    model.save(tmp_path / "model", include=["replay_buffer"])
    assert CGP.load(tmp_path / "model", env=Doubles(), device="cpu").learn(40).replay_buffer.device.type == "cpu"
    with pytest.raises(ValueError, match=r"`replay_buffer` is 'ReplayBuffer', but must be a NStepReplayBuffer"):
        CGP.load(tmp_path / "model", env=Doubles(), n_steps=3)


def test_a_model_whose_networks_could_not_be_made_has_no_buffer():
    model = make_model(Doubles(), _init_setup_model=False)
    model.policy_kwargs = dict(net_arch="wide")
    with pytest.raises(ValueError, match="net_arch"):
        model._setup_model()
    model.policy_kwargs = dict(net_arch=[8])
    model._setup_model()
    assert model.learn(40).replay_buffer.size() == 40


def test_a_buffer_that_was_saved_in_float64_still_trains(tmp_path):
    TD3("MlpPolicy", Doubles(), buffer_size=200, learning_starts=100).learn(60).save_replay_buffer(tmp_path / "buffer")
    model = make_model(Doubles())
    model.load_replay_buffer(tmp_path / "buffer")
    model.learn(60)
    assert model.replay_buffer.observations.dtype == np.float64
    assert model._n_updates == 30


@pytest.mark.parametrize("kind", ["observation", "reward"])
def test_a_value_that_float32_cannot_hold_stops_the_training(kind):
    class Huge(Doubles):
        def step(self, action):
            observation, reward, *rest = super().step(action)
            if self.steps == 3:
                observation, reward = (observation * 1e40, reward) if kind == "observation" else (observation, -1e40)
            return observation, reward, *rest

    with pytest.raises(ValueError, match=rf"infinite \(in float32\) {kind} at environment step 3"):
        make_model(Huge()).learn(10)


def test_spaces_keep_their_shape_and_their_bounds_where_float32_has_them():
    narrow = float32_space(spaces.Box(np.array([-1e300, 0.0]), np.array([1e300, 0.5]), dtype=np.float64))
    assert narrow == spaces.Box(np.array([-np.inf, 0.0], np.float32), np.array([np.inf, 0.5], np.float32))
    for space in (spaces.Box(0, 255, (4,), np.uint8), spaces.Discrete(3), spaces.Box(-1, 1, (2,), np.float32)):
        assert float32_space(space) is space
