"""Parts that do not fit together, and action spaces that cannot be scaled: adapted, or refused by name."""

import copy

import numpy as np
import pytest
import torch as th
from guarded import SMALL, GuardedTD3, Located, located
from gymnasium import spaces
from stable_baselines3 import TD3
from stable_baselines3.common.buffers import BaseBuffer, DictReplayBuffer
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise, VectorizedActionNoise
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import DummyVecEnv
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer
from trainings import Do

from sb3_cgp import CGP
from sb3_cgp.common.spaces import check_action_space
from sb3_cgp.guards.replay_buffer_fit import check_replay_buffer

pytestmark = pytest.mark.filterwarnings("ignore:Nothing is learnt")


def make_model(n_envs=1, **kwargs):
    return GuardedTD3("MlpPolicy", located(n_envs), **(SMALL | kwargs))


def normal(std=0.1):
    return NormalActionNoise(np.zeros(1), np.full(1, std))


@pytest.mark.parametrize("noise", [normal(), OrnsteinUhlenbeckActionNoise(np.zeros(1), np.ones(1))], ids=["normal", "OU"])
@pytest.mark.parametrize(("before", "after"), [(3, 1), (1, 3), (3, 2), (2, 2)])
def test_action_noise_follows_the_number_of_environments(noise, before, after, tmp_path):
    make_model(before, action_noise=noise).learn(12).save(tmp_path / "model")
    loaded = GuardedTD3.load(tmp_path / "model", located(after))
    loaded.learn(12)
    assert loaded.replay_buffer.actions.shape == (1000 // after, after, 1)
    assert loaded.action_noise().shape == ((after, 1) if after > 1 else (1,))
    base = loaded.action_noise.base_noise if after > 1 else loaded.action_noise
    assert repr(base) == repr(noise)


def test_noise_that_was_given_for_other_environments_follows_too():
    model = make_model(2, action_noise=VectorizedActionNoise(normal(), 4)).learn(20)
    assert len(model.action_noise.noises) == 2
    assert len({noise.item() for noise in model.action_noise()}) == 2


@pytest.mark.parametrize("n_envs", [1, 2])
def test_noise_of_another_shape_than_the_actions_is_refused(n_envs):
    noise = NormalActionNoise(np.zeros(3), np.ones(3))
    message = r"`action_noise` is .*NormalActionNoise.*, but must be noise .* shape, \(1,\), not \(3,\)"
    with pytest.raises(ValueError, match=message):
        make_model(n_envs, action_noise=noise)
    model = make_model(n_envs)
    model.action_noise = noise
    with pytest.raises(ValueError, match=message):
        model.learn(12)


@pytest.mark.parametrize("algorithm", [GuardedTD3, CGP])
@pytest.mark.parametrize("n_envs", [1, 3])
def test_noise_that_a_callback_sets_is_that_of_the_next_steps(algorithm, n_envs):
    model = algorithm("MlpPolicy", located(n_envs), **SMALL)
    model.learn(60, Do(5, lambda: setattr(model, "action_noise", normal(0.0))))
    assert isinstance(model.action_noise, VectorizedActionNoise) == (n_envs > 1)
    model = algorithm("MlpPolicy", located(n_envs), **SMALL)
    with pytest.raises(ValueError, match=r"`action_noise` is .*, but must be noise .* shape, \(1,\), not \(3,\)"):
        model.learn(60, Do(5, lambda: setattr(model, "action_noise", NormalActionNoise(np.zeros(3), np.ones(3)))))
    assert model.num_timesteps == 5 * n_envs


@pytest.mark.parametrize(
    ("kwargs", "error", "message"),
    [
        (
            dict(replay_buffer_class=HerReplayBuffer, replay_buffer_kwargs=dict(n_sampled_goals=4)),
            TypeError,
            r"`n_sampled_goals` is 4, but `HerReplayBuffer` takes no such argument.*`n_sampled_goal`",
        ),
        (
            dict(replay_buffer_class=HerReplayBuffer, replay_buffer_kwargs=dict(goal_selection_strategy="futur")),
            ValueError,
            r"`replay_buffer_kwargs\['goal_selection_strategy'\]` is 'futur', but must be one of 'future', 'final', 'episode'",
        ),
        (dict(replay_buffer_kwargs=dict(n_sampled_goal=4)), TypeError, "`n_sampled_goal` is 4, but `DictReplayBuffer` takes"),
    ],
)
def test_wrong_arguments_of_a_replay_buffer_are_refused_when_the_model_is_made_or_loaded(kwargs, error, message, tmp_path):
    def make(**arguments):
        return GuardedTD3("MultiInputPolicy", located(goals=True, length=7), **(SMALL | arguments))

    with pytest.raises(error, match=message):
        make(**kwargs)
    make(replay_buffer_class=kwargs.get("replay_buffer_class")).save(tmp_path / "model")
    with pytest.raises(error, match=message):
        GuardedTD3.load(tmp_path / "model", replay_buffer_kwargs=kwargs["replay_buffer_kwargs"])


def test_a_replay_buffer_of_the_users_own_may_take_any_argument():
    class Own(DictReplayBuffer):
        def __init__(self, *args, note, **kwargs):
            super().__init__(*args, **kwargs)
            self.note = note

    arguments = dict(replay_buffer_class=Own, replay_buffer_kwargs=dict(note="kept"))
    model = GuardedTD3("MultiInputPolicy", located(goals=True, length=7), **(SMALL | arguments))
    assert model.replay_buffer.note == "kept"


def test_whole_episodes_of_several_environments_are_refused():
    message = r"`train_freq` is \(1, 'episode'\), but must be in unit 'step' with 2 environments"
    with pytest.raises(ValueError, match=message):
        CGP("MlpPolicy", located(2), train_freq=(1, "episode"))
    assert CGP("MlpPolicy", located(1), train_freq=(1, "episode"), **SMALL).learn(20).num_timesteps >= 20


@pytest.mark.parametrize(("theirs", "ours"), [(4, 1), (1, 4), (2, 3)])
def test_a_replay_buffer_of_other_environments_is_refused_and_the_models_own_kept(theirs, ours, tmp_path):
    make_model(theirs).learn(12).save_replay_buffer(tmp_path / "buffer")
    model = make_model(ours).learn(12)
    own = model.replay_buffer
    with pytest.raises(ValueError, match=rf"`replay_buffer.n_envs` is {theirs}, but must be {ours}, .*`GuardedTD3.load\(path"):
        model.load_replay_buffer(tmp_path / "buffer")
    assert model.replay_buffer is own
    model.learn(12)


def test_a_replay_buffer_against_the_arguments_is_refused_in_any_algorithm_and_the_models_own_kept(tmp_path):
    make_model(n_steps=3).learn(12).save_replay_buffer(tmp_path / "buffer")
    model = make_model().learn(12)
    own = model.replay_buffer
    with pytest.raises(ValueError, match="`replay_buffer` is 'NStepReplayBuffer', but must be a ReplayBuffer, by the model's"):
        model.load_replay_buffer(tmp_path / "buffer")
    assert model.replay_buffer is own


def test_a_model_that_is_loaded_with_other_environments_refuses_its_old_buffer(tmp_path):
    model = make_model(2).learn(12)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = GuardedTD3.load(tmp_path / "model", located(4), force_reset=False)
    with pytest.raises(ValueError, match=r"`replay_buffer.n_envs` is 2, but must be 4"):
        loaded.load_replay_buffer(tmp_path / "buffer")
    # Its last observations are of two environments
    loaded.learn(12, reset_num_timesteps=False)
    assert loaded.replay_buffer.observations.shape[1] == 4
    np.testing.assert_array_equal(loaded.replay_buffer.observations[:3, :, 1], [[0] * 4, [1] * 4, [2] * 4])


def test_a_buffer_that_was_put_in_place_is_checked_when_learning_starts():
    model = make_model(2)
    model.replay_buffer = make_model(1).replay_buffer
    with pytest.raises(ValueError, match=r"`replay_buffer.n_envs` is 1, but must be 2"):
        model.learn(12)


def test_a_model_that_was_loaded_without_an_environment_says_how_to_learn(tmp_path):
    make_model().save(tmp_path / "model")
    with pytest.raises(ValueError, match=r"`env` is None, but must be an environment: `GuardedTD3.load\(path, env\)`"):
        GuardedTD3.load(tmp_path / "model").learn(12)


def test_environments_of_another_number_are_refused_by_set_env():
    with pytest.raises(AssertionError, match=r"\(3 != 2\).* you must use `GuardedTD3.load\(path, env\)` instead"):
        make_model(2).set_env(located(3))


def with_spaces(observations=None, actions=None):
    env = Located()
    env.observation_space = env.observation_space if observations is None else observations
    env.action_space = env.action_space if actions is None else actions
    return GuardedTD3("MlpPolicy", DummyVecEnv([lambda: env]), **SMALL)


@pytest.mark.parametrize(
    ("name", "space"),
    [
        ("observation_space", spaces.Box(-1, 1, (3,), np.float32)),
        ("observation_space", spaces.Box(0, 255, (2,), np.uint8)),
        ("observation_space", spaces.Discrete(2)),
        ("action_space", spaces.Box(-1, 1, (2,), np.float32)),
        ("action_space", spaces.Box(-2, 2, (1,), np.float32)),
    ],
    ids=str,
)
def test_a_replay_buffer_of_other_spaces_is_refused(name, space, tmp_path):
    other = with_spaces(**{name.removesuffix("_space") + "s": space})
    other.save_replay_buffer(tmp_path / "buffer")
    model = make_model()
    with pytest.raises(ValueError, match=rf"`replay_buffer.{name}` is .*, but must be"):
        model.load_replay_buffer(tmp_path / "buffer")


def test_a_replay_buffer_of_a_narrower_float_fits():
    model = make_model()
    check_replay_buffer(with_spaces(observations=spaces.Box(-np.inf, np.inf, (2,), np.float64)).replay_buffer, model)


def test_keys_of_observations_are_compared():
    goals = GuardedTD3("MultiInputPolicy", located(goals=True), **SMALL)
    env = Located(goals=True)
    env.observation_space = spaces.Dict({"observation": spaces.Box(-1, 1, (2,)), "achieved_goal": spaces.Box(-1, 1, (2,))})
    fewer = GuardedTD3("MultiInputPolicy", DummyVecEnv([lambda: env]), **SMALL)
    check_replay_buffer(goals.replay_buffer, goals)
    with pytest.raises(ValueError, match=r"`replay_buffer.observation_space`"):
        check_replay_buffer(fewer.replay_buffer, goals)


def test_a_model_with_hindsight_acts_without_an_environment(tmp_path):
    env = located(goals=True)
    arguments = SMALL | dict(learning_starts=20, replay_buffer_class=HerReplayBuffer)
    model = CGP("MultiInputPolicy", env, **arguments).learn(30)
    model.save(tmp_path / "model")
    loaded = CGP.load(tmp_path / "model")
    observation = env.reset()
    np.testing.assert_array_equal(loaded.predict(observation)[0], model.predict(observation)[0])
    with pytest.raises(ValueError, match=r"`env` is None, .*`CGP.load\(path, env\)`, or `set_env` before `learn`"):
        loaded.learn(10)
    loaded.set_env(env)
    assert loaded.learn(30).replay_buffer.size() == 30


LARGEST = np.finfo(np.float32).max


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (spaces.Box(-LARGEST, LARGEST, (2,), np.float32), r"`high - low` is finite in float32: give the environment closer"),
        (spaces.Box(np.array([-1, -LARGEST]), np.array([1, LARGEST * 0.1]), dtype=np.float32), "finite in float32"),
        (spaces.Box(np.float64(-1e308), np.float64(1e308), (1,), np.float64), "finite in float64"),
        (spaces.Box(np.float16(-6e4), np.float16(6e4), (1,), np.float16), "finite in float16"),
        (spaces.Box(0, 10, (2,), np.int64), "of a floating point dtype, such as float32"),
        (spaces.Box(0, 255, (2,), np.uint8), "of a floating point dtype, such as float32"),
        (spaces.Box(-1, np.inf, (2,), np.float32), "bounded: finite low < high"),
        (spaces.Box(1, 1, (2,), np.float32), "bounded: finite low < high"),
        (spaces.Box(-1, 1, (0,), np.float32), "bounded: finite low < high"),
        (spaces.Discrete(3), "a gymnasium.spaces.Box"),
        (spaces.Dict(a=spaces.Box(-1, 1)), "a gymnasium.spaces.Box"),
    ],
    ids=str,
)
@pytest.mark.filterwarnings("ignore:.*precision lowered")
def test_an_action_space_that_cannot_be_scaled_is_refused(space, message):
    with pytest.raises(ValueError, match=rf"(?s)`action_space` is .*, but must be .*{message}"):
        check_action_space(space)


@pytest.mark.parametrize("bound", [1e-30, 1.0, 1e30, 1.7e38])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_an_action_space_that_can_be_scaled_is_taken(bound, dtype):
    space = spaces.Box(-bound, bound, (2,), dtype)
    check_action_space(space)
    env = Located()
    env.action_space = space
    policy = GuardedTD3("MlpPolicy", DummyVecEnv([lambda: env]), **SMALL).policy
    for action in (space.low, space.high, (space.high / 2).astype(dtype)):
        np.testing.assert_allclose(policy.unscale_action(policy.scale_action(action)), action, rtol=1e-6)


class Paying(Located):
    """Pays more than another."""

    def compute_reward(self, achieved_goal, desired_goal, info):
        return np.full(len(achieved_goal), 5.0, np.float32)


def test_hindsight_asks_the_environment_that_was_set_last():
    model = GuardedTD3(
        "MultiInputPolicy", located(goals=True), replay_buffer_class=HerReplayBuffer, **SMALL | dict(learning_starts=16)
    ).learn(20)
    model.set_env(DummyVecEnv([lambda: Paying(goals=True)]))
    model.learn(10, reset_num_timesteps=False)
    assert 5.0 in model.replay_buffer.sample(64).rewards
    # A copied buffer has no environment until it learns
    copied = copy.deepcopy(model)
    copied.learn(10, reset_num_timesteps=False)
    assert copied.replay_buffer.env is copied.env


class Listing(BaseBuffer):
    """Stores transitions in a list, and has no array of SB3's."""

    def __init__(self, *args, optimize_memory_usage=False, **kwargs):
        super().__init__(*args, **kwargs)
        self.transitions = []

    def add(self, obs, next_obs, action, reward, done, infos):
        self.transitions.append([th.as_tensor(each, dtype=th.float32) for each in (obs, action, next_obs, done, reward)])
        self.pos += 1

    def _get_samples(self, batch_inds, env=None):
        fields = zip(*(self.transitions[index] for index in batch_inds), strict=True)
        observations, actions, next_observations, dones, rewards = map(th.stack, fields)
        return ReplayBufferSamples(observations[:, 0], actions[:, 0], next_observations[:, 0], dones, rewards)


@pytest.mark.parametrize("algorithm", [TD3, GuardedTD3, CGP])
def test_a_buffer_that_stores_in_its_own_way_is_trained_on_again_and_again(algorithm):
    model = algorithm("MlpPolicy", located(), replay_buffer_class=Listing, **SMALL).learn(20)
    model.learn(20)
    model.learn(20, reset_num_timesteps=False)
    assert len(model.replay_buffer.transitions) == 60
    assert model._n_updates == 14 + 14 + 20
