"""CGP's arguments: what is refused at construction, and how."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from small_models import make_model
from stable_baselines3 import TD3, HerReplayBuffer
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.noise import NormalActionNoise, VectorizedActionNoise

from sb3_cgp import CGPPolicy

UNBOUNDED = spaces.Box(-np.inf, np.inf, (1,), np.float32)
EMPTY = spaces.Box(np.ones(1, np.float32), np.ones(1, np.float32))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (dict(cem_elites=9), "`cem_elites` is 9, but must be at most `cem_samples`, which is 8"),
        (dict(cem_iterations=0), "`cem_iterations` is 0, but must be an integer >= 1"),
        (dict(cem_samples=-1), "`cem_samples` is -1, but must be an integer >= 1"),
        (dict(cem_samples=8.0), "`cem_samples` is 8.0, but must be an integer >= 1"),
        (dict(cem_elites=True), "`cem_elites` is True, but must be an integer >= 1"),
        (dict(cem_result="median"), "`cem_result` is 'median', but must be one of 'best', 'mean'"),
        (dict(cem_dtype="float16"), "`cem_dtype` is 'float16', but must be one of 'auto', 'float32', 'bfloat16'"),
        (dict(cuda_graphs="yes"), "`cuda_graphs` is 'yes', but must be True or False"),
        (dict(policy_kwargs=dict(cem_dtype="float32")), "'cem_dtype'.*outside `policy_kwargs`"),
        (dict(batch_size=0), "`batch_size` is 0, but must be an integer >= 1"),
        (dict(buffer_size=0), "`buffer_size` is 0, but must be an integer >= 1"),
        (dict(n_steps=0), "`n_steps` is 0, but must be an integer >= 1"),
        (
            dict(n_steps=3, optimize_memory_usage=True),
            "`optimize_memory_usage` is True, but must be False with a Dict .* or `n_steps`",
        ),
        (dict(learning_starts=-1), "`learning_starts` is -1, but must be an integer >= 0"),
        (dict(learning_starts=9.5), "`learning_starts` is 9.5, but must be an integer >= 0"),
        (dict(learning_starts=np.inf), "`learning_starts` is inf, but must be an integer >= 0"),
        (dict(learning_starts=True), "`learning_starts` is True, but must be an integer >= 0"),
        (dict(gradient_steps=-2), "`gradient_steps` is -2, but must be an integer >= -1"),
        (dict(train_freq=[1, "step"]), "`train_freq` is .*, but must be an int, or a tuple of an int and a unit"),
        (dict(policy_kwargs=dict(inference="cem")), "'inference'.*outside `policy_kwargs`"),
        (dict(train_freq=0), "`train_freq` is 0, but must be an integer >= 1"),
        (dict(train_freq=(1, "day")), "`train_freq` is .*, but must be in unit 'step' or 'episode'"),
        (dict(policy_delay=0), "`policy_delay` is 0, but must be an integer >= 1"),
        (dict(target_update_interval=-1), "`target_update_interval` is -1, but must be an integer >= 1"),
        (dict(tau=1.5), r"`tau` is 1.5, but must be a number within \[0, 1\]"),
        (dict(gamma=-0.1), r"`gamma` is -0.1, but must be a number within \[0, 1\]"),
        (dict(target_policy_noise=-0.2), "`target_policy_noise` is -0.2, but must be a finite number >= 0"),
        (dict(target_noise_clip=np.nan), "`target_noise_clip` is nan, but must be a finite number >= 0"),
        (dict(action_noise=0.1), "`action_noise` is 0.1, but must be None or an ActionNoise, such as NormalActionNoise"),
        (dict(action_noise="normal"), "`action_noise` is 'normal', but must be None or an ActionNoise"),
        (dict(action_noise=NormalActionNoise(np.zeros(1), -np.ones(1))), "`action_noise` is .* standard deviation >= 0"),
        (dict(learning_rate=-1e-3), "`learning_rate` is -0.001, but must be a finite number >= 0"),
        (dict(actor_learning_rate="fast"), "`actor_learning_rate` is 'fast', but must be a number >= 0, a schedule, or"),
        (dict(actor_learning_rate="lin_-1"), "`actor_learning_rate` is 'lin_-1'"),
        (dict(policy_loss="sac"), "`policy_loss` is 'sac', but must be one of 'cgp', 'qgp', None"),
        (dict(policy_training="never"), "`policy_training` is 'never', but must be one of 'online', 'offline'"),
        (dict(inference="oracle"), "`inference` is 'oracle', but must be one of 'actor', 'averaged_actor', 'cem'"),
        (dict(policy_loss=None, policy_training="offline"), "`policy_training` is 'offline', but must be 'online'"),
        (dict(policy_loss=None, inference="actor"), "`inference` is 'actor', but must be 'cem'"),
        (dict(policy_loss=None, inference="averaged_actor"), "`inference` is 'averaged_actor', but must be 'cem'"),
        (
            dict(policy_training="offline", policy_kwargs=dict(share_features_extractor=True)),
            "`share_features_extractor` is True, but must be False",
        ),
    ],
    ids=str,
)
def test_bad_arguments_are_refused_at_construction_by_name_value_and_what_is_allowed(arguments, message):
    with pytest.raises(ValueError, match=message):
        make_model(**arguments)


@pytest.mark.parametrize(
    "action_space", [spaces.Discrete(3), spaces.MultiBinary(2), UNBOUNDED, EMPTY, spaces.Box(-1, 1, (0,))], ids=str
)
def test_action_spaces_that_cem_cannot_search_are_refused(action_space):
    class Unsearchable(gym.Env):
        observation_space = spaces.Box(-1, 1, (2,))

    Unsearchable.action_space = action_space
    with pytest.raises(ValueError, match=r"`action_space` is .*, but must be"):
        make_model(Unsearchable())


@pytest.mark.parametrize("name", ["learning_rate", "actor_learning_rate"])
def test_schedules_are_tried_from_the_beginning_to_the_end(name):
    with pytest.raises(ValueError, match=rf"`{name}\(0.5\)` is -0.0005, but must be a finite number >= 0"):
        make_model(**{name: lambda remaining: 1e-3 * (remaining - 1)})
    with pytest.raises(ValueError, match=rf"`{name}\(0.0\)` is -0.0001, but must be a finite number >= 0"):
        make_model(**{name: lambda remaining: 1e-3 * (remaining - 0.1)})
    with pytest.raises(ValueError, match=rf"`{name}` is .* must be a schedule .*; at 0.0 it raises ZeroDivisionError"):
        make_model(**{name: lambda remaining: 1e-3 / remaining})
    with pytest.raises(ValueError, match=rf"`{name}` is .* must be a schedule .*; at 0.0 it raises IndexError"):
        make_model(**{name: lambda remaining: [1e-3, 1e-4][int((1 - remaining) * 2)]})


def test_noise_of_several_environments_is_checked_too():
    noise = VectorizedActionNoise(NormalActionNoise(np.zeros(1), -np.ones(1)), 2)
    with pytest.raises(ValueError, match="`action_noise`"):
        make_model(action_noise=noise)


@pytest.mark.parametrize("buffer_class", [None, HerReplayBuffer])
def test_a_memory_efficient_buffer_of_dict_observations_is_refused_by_name(buffer_class):
    env = BitFlippingEnv(4, continuous=True)
    with pytest.raises(ValueError, match="`optimize_memory_usage` is True, but must be False with a Dict observation space"):
        make_model(env, "MultiInputPolicy", replay_buffer_class=buffer_class, optimize_memory_usage=True)


@pytest.mark.parametrize("argument", ["inference", "cem_dtype"])
def test_a_policy_refuses_an_unknown_choice(argument):
    box = spaces.Box(-1, 1, (1,))
    with pytest.raises(ValueError, match=f"`{argument}` is 'dream'"):
        CGPPolicy(box, box, lambda _: 1e-3, **{argument: "dream"})


def test_refuses_a_policy_that_has_no_selector():
    with pytest.raises(ValueError, match=r"`policy` is .*TD3Policy.*, but must be a subclass of sb3_cgp.CGPPolicy"):
        make_model(policy=TD3.policy_aliases["MlpPolicy"])
