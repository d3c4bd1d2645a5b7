"""Whatever SB3's TD3 can do, CGP can: spaces, environments, buffers, networks and tools of SB3."""

from operator import attrgetter

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.callbacks import CheckpointCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import BitFlippingEnv, FakeImageEnv, IdentityEnvBox, SimpleMultiObsEnv
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor, NatureCNN
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize
from torch import nn

from sb3_cgp import CGP, CGPPolicy, Selection


def make_model(env="Pendulum-v1", policy="MlpPolicy", **kwargs):
    arguments = dict(learning_starts=40, buffer_size=400, batch_size=8, cem_samples=8, cem_elites=2, seed=0)
    arguments["policy_kwargs"] = dict(net_arch=[16])
    arguments.update(kwargs)
    return CGP(policy, env, **arguments)


def learns(model, steps=100):
    """Train for a while, and check that gradient steps were taken and left finite networks that act within bounds."""
    model.learn(steps)
    assert model._n_updates > 0
    assert all(parameter.isfinite().all() for parameter in model.policy.parameters())
    action, _ = model.predict(model.observation_space.sample())
    assert model.action_space.contains(action)
    return model


@pytest.mark.parametrize("vec_env_class", [DummyVecEnv, SubprocVecEnv])
def test_several_environments_at_once(vec_env_class):
    env = make_vec_env("Pendulum-v1", n_envs=3, vec_env_cls=vec_env_class)
    model = learns(make_model(env, action_noise=NormalActionNoise(np.zeros(1), 0.1 * np.ones(1))), 150)
    assert model.num_timesteps == 150
    assert model._n_updates == (150 - 42) // 3 + 1
    env.close()


@pytest.mark.parametrize(
    ("train_freq", "gradient_steps", "n_updates"),
    [((1, "episode"), -1, 75), ((1, "episode"), 7, 21), (4, 1, 15), ((5, "step"), -1, 60), (1, 0, 0), (1, 3, 180)],
)
@pytest.mark.usefixtures("short_episodes")
def test_training_frequencies(train_freq, gradient_steps, n_updates):
    model = make_model(train_freq=train_freq, gradient_steps=gradient_steps)
    model.learn(100)
    assert model._n_updates == n_updates


def test_n_step_returns():
    model = learns(make_model(n_steps=3))
    assert isinstance(model.replay_buffer, NStepReplayBuffer)
    assert model.replay_buffer.sample(4).discounts.unique().item() == pytest.approx(0.99**3)


@pytest.mark.parametrize("low_high", [(-0.4, 0.4), (-2.0, 2.0), (0.0, 10.0), (-3.0, 1.0)])
def test_action_bounds_of_every_kind(low_high):
    low, high = low_high
    env = IdentityEnvBox(low=low, high=high, eps=0.5)
    model = learns(make_model(env))
    buffer = model.replay_buffer
    # Stored as scaled, whatever the bounds, both in the warm-up and later
    assert np.abs(buffer.actions[:100]).max() <= 1.0
    assert np.ptp(buffer.actions[:40]) > 1.5
    actor_action = model.actor(th.zeros(1, 1)).item()
    action = model.predict(np.zeros(1, np.float32))[0].item()
    assert action == pytest.approx(low + (actor_action + 1) / 2 * (high - low), abs=1e-5)


def test_actions_of_several_dimensions_and_shapes():
    class Matrix(gym.Env):
        observation_space = spaces.Box(-1, 1, (2, 2), np.float64)
        action_space = spaces.Box(np.array([[-1.0, 0.0, -2.0]], np.float32), np.array([[1.0, 5.0, 0.5]], np.float32))

        def reset(self, *, seed=None, options=None):
            return self.observation_space.sample(), {}

        def step(self, action):
            assert self.action_space.contains(action)
            return self.observation_space.sample(), float(action.sum()), False, False, {}

    model = learns(make_model(Matrix()))
    assert model.predict(np.zeros((5, 2, 2)))[0].shape == (5, 1, 3)


def test_images():
    env = FakeImageEnv(screen_height=36, screen_width=36, n_channels=1, discrete=False)
    model = learns(make_model(env, "CnnPolicy", policy_kwargs=dict(features_extractor_kwargs=dict(features_dim=8))), 60)
    assert isinstance(model.critic.features_extractor, NatureCNN)
    assert model.critic.q_networks[0][0].weight.shape == (256, 8 + 5)


def test_dict_observations():
    learns(make_model(SimpleMultiObsEnv(discrete_actions=False, random_start=False), "MultiInputPolicy"), 60)


@pytest.mark.parametrize("n_envs", [1, 2])
def test_hindsight_replay_on_a_goal_environment(n_envs, tmp_path):
    env = make_vec_env(lambda: BitFlippingEnv(n_bits=4, continuous=True), n_envs=n_envs)
    her = dict(replay_buffer_class=HerReplayBuffer, replay_buffer_kwargs=dict(n_sampled_goal=2))
    model = learns(make_model(env, "MultiInputPolicy", **her))
    model.save(tmp_path / "model")
    loaded = CGP.load(tmp_path / "model", env=env)
    loaded.learn(80)
    assert loaded.replay_buffer.n_sampled_goal == 2


def test_vec_normalize_trains_on_normalised_and_stores_original_values():
    env = VecNormalize(make_vec_env("Pendulum-v1"), gamma=0.99)
    model = learns(make_model(env, device="cpu"))
    # Pendulum's angular velocity reaches 8, its normalised value hardly 3
    assert np.abs(model.replay_buffer.observations[:100, 0, 2]).max() > 3.5
    stored = model.replay_buffer.observations[:100, 0]
    batch = model.replay_buffer.sample(32, env=env).observations.numpy()
    normalised = env.normalize_obs(stored)
    assert all(np.abs(normalised - row).max(axis=1).min() < 1e-5 for row in batch)


def test_an_infinite_value_is_found_behind_vec_normalize():
    class Infinite(gym.Wrapper):
        def step(self, action):
            observation, _, terminated, truncated, info = self.env.step(action)
            return observation, -np.inf, terminated, truncated, info

    with pytest.raises(ValueError, match="reward at environment step 1"):
        make_model(VecNormalize(DummyVecEnv([lambda: Infinite(gym.make("Pendulum-v1"))]))).learn(10)


def test_memory_efficient_replay():
    kwargs = dict(optimize_memory_usage=True, replay_buffer_kwargs=dict(handle_timeout_termination=False))
    model = learns(make_model(**kwargs))
    assert model.replay_buffer.optimize_memory_usage
    assert not hasattr(model.replay_buffer, "next_observations")


@pytest.mark.parametrize("noise_class", [NormalActionNoise, OrnsteinUhlenbeckActionNoise])
def test_action_noise_is_added_to_cems_actions(noise_class):
    class Idle:
        def select(self, score, n_states, action_dim, device="cpu"):
            return Selection(th.zeros(n_states, action_dim), th.zeros(n_states, 1, action_dim))

    noise = noise_class(np.zeros(1), 0.2 * np.ones(1))
    for action_noise, idle in ((noise, False), (None, True)):
        model = make_model(action_noise=action_noise, policy_kwargs=dict(net_arch=[16], selector=Idle())).learn(100)
        assert (model.replay_buffer.actions[40:100] == 0.0).all() == idle
    assert abs(model.replay_buffer.actions).max() <= 1.0


class NormalisedDropout(BaseFeaturesExtractor):
    """Batch norm and dropout, and a count of the rows that come through."""

    def __init__(self, observation_space):
        super().__init__(observation_space, features_dim=3)
        self.norm = nn.BatchNorm1d(3)
        self.dropout = nn.Dropout(0.5)
        self.rows = []

    def forward(self, observations):
        self.rows.append((len(observations), self.training))
        return self.dropout(self.norm(observations))


def test_batch_norm_and_dropout_keep_their_modes_and_statistics():
    kwargs = dict(net_arch=[16], features_extractor_class=NormalisedDropout)
    model = make_model(policy_kwargs=kwargs, target_update_interval=2)
    initial = model.actor.features_extractor.norm.running_mean.clone()
    model.learn(40)
    assert th.equal(model.actor.features_extractor.norm.running_mean, initial)

    model.train(gradient_steps=2, batch_size=8)
    for network, average in ((model.actor, model.actor_target), (model.critic, model.critic_target)):
        running = network.features_extractor.norm
        assert not th.equal(running.running_mean, initial)
        # Statistics are copied, not averaged
        assert th.equal(running.running_mean, average.features_extractor.norm.running_mean)
        assert th.equal(running.running_var, average.features_extractor.norm.running_var)
        assert not average.training

    # Neither acting nor predicting is random or changes a statistic
    statistics = {key: value.clone() for key, value in model.policy.state_dict().items() if "running" in key}
    observation = np.zeros(3, np.float32)
    assert np.array_equal(model.predict(observation)[0], model.predict(observation)[0])
    model.policy.select_actions(th.zeros(5, 3), model.critic)
    model.policy.set_training_mode(True)
    model.policy.select_actions(th.zeros(5, 3), model.critic)
    assert model.critic.training
    for key, value in statistics.items():
        assert th.equal(model.policy.state_dict()[key], value)


@pytest.mark.parametrize(
    "name", ["actor", "critic", "policy", "actor.features_extractor", "critic.features_extractor.dropout"]
)
def test_predicting_evaluates_whichever_network_was_left_in_training_mode(name):
    model = make_model(policy_kwargs=dict(net_arch=[16], features_extractor_class=NormalisedDropout))
    modules = list(model.policy.actor.modules()) + list(model.policy.critic.modules())
    model.policy.set_training_mode(True)
    assert all(module.training for module in modules)
    for _ in range(2):
        model.predict(np.zeros(3, np.float32))
        assert not any(module.training for module in (model.policy, *modules))
        attrgetter(name)(model).train()


def test_predicting_evaluates_a_features_extractor_that_was_exchanged():
    model = make_model(policy_kwargs=dict(net_arch=[16], features_extractor_class=NormalisedDropout))
    observation = np.zeros(3, np.float32)
    model.predict(observation)
    for network in (model.actor, model.actor_target, model.critic, model.critic_target):
        network.features_extractor = NormalisedDropout(model.observation_space)
    for inference in ("actor", "averaged_actor"):
        model.policy.inference = inference
        assert np.array_equal(model.predict(observation)[0], model.predict(observation)[0])
    # For bootstrapping
    model.policy.select_actions(th.zeros(5, 3), model.critic_target)
    assert model.critic_target.features_extractor.rows == [(5, False)]


def test_observations_pass_the_features_extractor_once_per_state_never_per_sample():
    model = make_model(policy_kwargs=dict(net_arch=[16], features_extractor_class=NormalisedDropout), cem_samples=32)
    extractor = model.critic.features_extractor
    extractor.rows.clear()
    model.policy.select_actions(th.zeros(5, 3), model.critic)
    assert extractor.rows == [(5, False)]
    model.learn(45)
    assert max(rows for rows, _ in extractor.rows) == 8


def test_a_shared_features_extractor_learns_from_the_policy_alone():
    model = make_model(policy_kwargs=dict(net_arch=[16], features_extractor_class=Linear, share_features_extractor=True))
    assert model.actor.features_extractor is model.critic.features_extractor
    before = model.actor.features_extractor.linear.weight.clone()
    learns(model)
    assert not th.equal(before, model.actor.features_extractor.linear.weight)


class Linear(FlattenExtractor):
    def __init__(self, observation_space):
        super().__init__(observation_space)
        self.linear = nn.Linear(self.features_dim, self.features_dim)

    def forward(self, observations):
        return self.linear(super().forward(observations))


@pytest.mark.parametrize("net_arch", [[], [8], dict(pi=[4], qf=[12, 8, 4])])
@pytest.mark.parametrize("n_critics", [1, 3])
def test_network_sizes_of_actor_and_critics_apart(net_arch, n_critics):
    model = learns(make_model(policy_kwargs=dict(net_arch=net_arch, n_critics=n_critics, activation_fn=nn.Tanh)), 60)
    pi, qf = (net_arch["pi"], net_arch["qf"]) if isinstance(net_arch, dict) else (net_arch, net_arch)
    sizes = [
        [layer.out_features for layer in net if isinstance(layer, nn.Linear)] for net in (model.actor.mu, model.critic.qf0)
    ]
    assert sizes == [[*pi, 1], [*qf, 1]]
    assert len(model.critic.q_networks) == n_critics


class OwnPolicy(CGPPolicy):
    """A policy class of the user's own."""


def test_a_policy_class_of_ones_own_is_pickled_with_the_model(tmp_path):
    model = make_model(policy=OwnPolicy).learn(60)
    model.save(tmp_path / "model")
    loaded = CGP.load(tmp_path / "model")
    assert type(loaded.policy) is OwnPolicy
    observation = model.observation_space.sample()
    assert np.array_equal(loaded.predict(observation)[0], model.predict(observation)[0])


def test_logger_tensorboard_and_checkpoints(tmp_path):
    model = make_model(tensorboard_log=tmp_path / "runs", verbose=0)
    callback = CheckpointCallback(50, tmp_path / "checkpoints", save_replay_buffer=True)
    model.learn(100, callback=callback, progress_bar=True)
    assert list((tmp_path / "runs").glob("CGP_1/events*"))
    assert {path.name for path in (tmp_path / "checkpoints").iterdir()} == {
        f"rl_model_{name}"
        for name in ("50_steps.zip", "100_steps.zip", "replay_buffer_50_steps.pkl", "replay_buffer_100_steps.pkl")
    }
    model.set_logger(configure(str(tmp_path / "csv"), ["csv"]))
    model.learn(400, log_interval=1, reset_num_timesteps=False)
    header = (tmp_path / "csv" / "progress.csv").read_text().splitlines()[0]
    assert {"train/critic_loss", "train/cem_std", "rollout/ep_rew_mean", "time/fps"} <= set(header.split(","))


def test_learning_goes_on_where_it_stopped():
    model = make_model().learn(100)
    model.learn(50, reset_num_timesteps=False)
    assert model.num_timesteps == 150
    assert model._n_updates == 110
    model.set_env(Monitor(gym.make("Pendulum-v1")))
    model.learn(60)
    assert model.num_timesteps == 60
    assert np.isfinite(evaluate_policy(model, model.get_env(), 1)[0])


def test_float64_observations_are_computed_in_float32():
    class Precise(gym.ObservationWrapper):
        def __init__(self, env):
            super().__init__(env)
            self.observation_space = spaces.Box(-8, 8, (3,), np.float64)

        def observation(self, observation):
            return observation.astype(np.float64)

    model = learns(make_model(Precise(gym.make("Pendulum-v1"))))
    assert {parameter.dtype for parameter in model.policy.parameters()} == {th.float32}
    assert model.policy.select_actions(th.zeros(2, 3, dtype=th.float64), model.critic).actions.dtype == th.float32


@pytest.mark.usefixtures("gpu")
def test_trains_and_loads_on_a_gpu(tmp_path):
    model = learns(make_model(device="cuda"))
    model.save(tmp_path / "model")
    observation = model.observation_space.sample()
    assert CGP.load(tmp_path / "model", device="cpu").predict(observation)[0] == pytest.approx(
        model.predict(observation)[0], abs=1e-4
    )
