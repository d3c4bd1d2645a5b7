"""Errors that the first gradient step would raise are raised when a model is made, and nothing else changes."""

import copy
import random
import re

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from guarded import ACTIONS, SMALL, GuardedTD3, Located, located
from gymnasium import spaces
from stable_baselines3 import DDPG, SAC, TD3
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer
from torch import nn

from sb3_cgp import CGP, MlpPolicy, Selection
from sb3_cgp.guards import GuardedAlgorithm


class Extractor(BaseFeaturesExtractor):
    """Flattens observations, and normalises batches."""

    def __init__(self, observation_space):
        super().__init__(observation_space, 2)
        self.norm = nn.BatchNorm1d(2)
        self.cache = None
        self.calls = 0

    def forward(self, observations):
        self.calls += 1
        return self.norm(observations)


class Caching(Extractor):
    def forward(self, observations):
        if self.cache is None:
            self.cache = self.norm.weight.new_ones(2) + th.randn(2)
        return super().forward(observations) * self.cache


class WrongShape(Extractor):
    def forward(self, observations):
        return super().forward(observations)[:, :1]


class InPlace(Extractor):
    """Works without gradients, and not with them."""

    def forward(self, observations):
        features = th.sigmoid(super().forward(observations))
        product = features * features
        features += 1
        return product


class OneRow(Extractor):
    """Works while acting in one environment, and not on a batch."""

    def forward(self, observations):
        return self.norm(observations.reshape(1, 2)) if not self.training else super().forward(observations.reshape(1, 2))


def make_model(extractor=Extractor, algorithm=GuardedTD3, **kwargs):
    policy_kwargs = dict(net_arch=[4], features_extractor_class=extractor)
    env = located()
    env.observation_space.seed(3)
    return algorithm("MlpPolicy", env, **(SMALL | dict(policy_kwargs=policy_kwargs) | kwargs))


@pytest.mark.parametrize(
    ("extractor", "arguments", "message"),
    [
        (WrongShape, dict(), "mat1 and mat2 shapes cannot be multiplied"),
        (InPlace, dict(), "modified by an inplace operation"),
        (OneRow, dict(), "shape '[1, 2]' is invalid"),
        # Batch norm learns from two at least
        (Extractor, dict(batch_size=1), "Expected more than 1 value per channel when training"),
    ],
)
def test_a_features_extractor_that_fails_is_refused_at_construction(extractor, arguments, message):
    plain = make_model(extractor, TD3, **arguments)
    # SB3 says it when it acts, or later
    with pytest.raises((RuntimeError, ValueError), match=re.escape(message)):
        plain.learn(20)
    expected = rf"The actor cannot learn from a batch of `observation_space`, Box\(.*{re.escape(message)}.*`policy_kwargs`"
    with pytest.raises(ValueError, match=rf"(?s){expected}") as caught:
        make_model(extractor, **arguments)
    assert caught.value.__cause__ is not None


@pytest.mark.parametrize(
    ("frozen", "arguments"),
    [("actor", dict(policy_loss=None)), ("critic", dict(policy_training="offline"))],
)
def test_networks_that_are_frozen_on_purpose_are_taken(frozen, arguments, tmp_path):
    class Frozen(MlpPolicy):
        def __init__(self, *args, **kwargs):
            super().__init__(*args, **kwargs)
            getattr(self, frozen).requires_grad_(False)

    model = CGP(Frozen, located(), **(SMALL | arguments))
    model.save(tmp_path / "model")
    loaded = CGP.load(tmp_path / "model")
    assert not any(parameter.requires_grad for parameter in getattr(loaded, frozen).parameters())


@pytest.mark.parametrize("arguments", [{}, dict(policy_loss="qgp"), dict(cem_start="actor")])
def test_an_actor_that_is_frozen_stays_and_the_critics_learn(arguments):
    """As with SB3's TD3: for critics that are trained first under a policy from elsewhere."""
    model = CGP("MlpPolicy", located(), **(SMALL | arguments))
    model.actor.requires_grad_(False)
    before = copy.deepcopy(model.policy.state_dict())
    model.learn(20)
    changed = {name for name, value in model.policy.state_dict().items() if not th.allclose(value, before[name], atol=1e-6)}
    assert {name.partition(".")[0] for name in changed} == {"critic", "critic_target"}
    model.actor.requires_grad_(True)
    model.learn(20, reset_num_timesteps=False)
    assert not th.equal(model.actor.mu[2].bias, before["actor.mu.2.bias"])


class Lazy(BaseFeaturesExtractor):
    def __init__(self, observation_space, is_initialised=False):
        super().__init__(observation_space, 3)
        self.layer = nn.LazyLinear(3)
        if is_initialised:
            self.layer(th.zeros(1, *observation_space.shape))

    def forward(self, observations):
        return self.layer(observations)


@pytest.mark.parametrize("is_shared", [False, True])
def test_lazy_layers_are_refused_unless_they_are_initialised(is_shared):
    kwargs = dict(net_arch=[4], features_extractor_class=Lazy, share_features_extractor=is_shared)
    message = r"`policy.actor.features_extractor.layer.weight` is .*, but must be initialised .* `nn.Linear\(n, 8\)` for"
    with pytest.raises(ValueError, match=message):
        make_model(algorithm=CGP, policy_kwargs=kwargs)
    kwargs["features_extractor_kwargs"] = dict(is_initialised=True)
    assert make_model(algorithm=CGP, policy_kwargs=kwargs).learn(20)._n_updates > 0


@pytest.mark.parametrize("algorithm", [TD3, CGP])
def test_a_critic_that_is_frozen_ends_the_training_as_in_sb3(algorithm):
    model = algorithm("MlpPolicy", located(), **SMALL)
    model.critic.requires_grad_(False)
    with pytest.raises(RuntimeError, match="does not require grad"):
        model.learn(20)


@pytest.mark.parametrize("extractor", [Extractor, Caching])
def test_a_trial_leaves_no_trace(extractor):
    class Unguarded(GuardedTD3):
        """Without the trial."""

    Unguarded._try_networks = lambda self: None
    states, models = [], []
    for algorithm in (Unguarded, GuardedTD3):
        models.append(make_model(extractor, algorithm))
        states.append((th.rand(1), np.random.rand(), random.random(), models[-1].observation_space.sample()))  # noqa: NPY002
    assert repr(states[0]) == repr(states[1])
    for name, value in models[0].policy.state_dict().items():
        assert th.equal(models[1].policy.state_dict()[name], value), name
    for network in (models[1].actor, models[1].critic, models[1].actor_target, models[1].critic_target):
        assert network.features_extractor.calls == 0
        assert network.features_extractor.cache is None
        assert all(parameter.grad is None for parameter in network.parameters())
        assert network.training is False or network in (models[1].actor, models[1].critic)


def test_an_extractor_that_caches_a_tensor_learns():
    model = make_model(Caching).learn(30)
    assert model._n_updates > 0
    assert model.actor.features_extractor.cache is not None


def make_on(space):
    env = Located()
    env.observation_space = space
    policy = "MultiInputPolicy" if isinstance(space, spaces.Dict) else "MlpPolicy"
    return GuardedTD3(policy, DummyVecEnv([lambda: env]), **SMALL)


@pytest.mark.parametrize(
    ("space", "name"),
    [
        (spaces.Box(-1, 1, (), np.float32), r"observation_space"),
        (spaces.Dict(a=spaces.Box(-1, 1, (2,)), b=spaces.Box(-1, 1, ())), r"observation_space\['b'\]"),
    ],
    ids=str,
)
def test_a_scalar_observation_is_refused_with_the_remedy(space, name):
    with pytest.raises(ValueError, match=rf"`{name}` is Box\(.*\), but must be of a shape .* such as \(1,\)"):
        make_on(space)


@pytest.mark.parametrize(
    ("space", "remedy"),
    [
        (spaces.Discrete(5, start=3), "with `start` 0, as SB3 encodes numbers from 0: subtract `start`"),
        (spaces.Dict(a=spaces.MultiDiscrete([2, 3], start=[0, 1])), "with `start` 0"),
        (spaces.MultiDiscrete([[2, 3], [4, 2]]), "of one axis, .*: flatten the space"),
    ],
    ids=str,
)
def test_a_discrete_observation_that_sb3_cannot_encode_is_refused_with_the_remedy(space, remedy):
    with pytest.raises(ValueError, match=rf"(?s)`observation_space.* is .*Discrete\(.*, but must be {remedy}"):
        make_on(space)


@pytest.mark.parametrize(
    "space",
    [
        spaces.Box(-np.inf, np.inf, (2, 3), np.float64),
        spaces.Box(0, 255, (3, 36, 36), np.uint8),
        spaces.Discrete(4),
        spaces.MultiDiscrete([2, 3]),
        spaces.MultiBinary(3),
        spaces.MultiBinary((2, 3)),
        spaces.Dict(a=spaces.Box(-1, 1, (1,)), b=spaces.Discrete(3), c=spaces.Box(0, 255, (3, 36, 36), np.uint8)),
    ],
    ids=str,
)
@pytest.mark.parametrize("algorithm", [TD3, SAC, DDPG])
def test_observations_of_every_space_of_sb3_pass_the_trial(space, algorithm):
    guarded = type("Guarded", (GuardedAlgorithm, algorithm), {})
    env = Located()
    env.observation_space = space
    env.observe = space.sample
    policy = "MultiInputPolicy" if isinstance(space, spaces.Dict) else "MlpPolicy"
    model = guarded(policy, DummyVecEnv([lambda: env]), **(SMALL | dict(buffer_size=20, policy_kwargs=dict(net_arch=[4]))))
    assert model.learn(9)._n_updates > 0


@pytest.mark.parametrize("is_dict", [False, True])
def test_observations_of_a_space_that_cannot_be_sampled_pass_the_trial(is_dict):
    """Gymnasium's ``sample`` overflows."""
    widest, env = np.finfo(np.float64).max, Located()
    box = spaces.Box(-widest, widest, (2,), np.float64)
    env.observation_space = spaces.Dict(x=box) if is_dict else box
    env.observe = lambda: {"x": np.ones(2)} if is_dict else np.ones(2)
    policy = "MultiInputPolicy" if is_dict else "MlpPolicy"
    assert GuardedTD3(policy, DummyVecEnv([lambda: env]), **(SMALL | dict(buffer_size=20))).learn(9)._n_updates > 0


def test_hindsight_needs_goals_and_their_rewards():
    arguments = SMALL | dict(replay_buffer_class=HerReplayBuffer)
    with pytest.raises(ValueError, match=r"`observation_space` is .*, but must be a Dict with the keys 'observation'"):
        GuardedTD3("MlpPolicy", located(), **arguments)

    class NoReward(Located):
        @property
        def compute_reward(self):
            raise AttributeError("compute_reward")

    with pytest.raises(ValueError, match=r"`env` is .*, but must be one with a method `compute_reward"):
        GuardedTD3("MultiInputPolicy", DummyVecEnv([lambda: NoReward(goals=True)]), **arguments)


def test_a_selector_of_a_wrong_shape_is_refused():
    class Selecting(TD3):
        def _setup_model(self):
            super()._setup_model()
            selection = type("Selection", (), {"actions": th.zeros(3, 5)})
            self.policy.select_actions = lambda observations, critic: selection

    with pytest.raises(ValueError, match=r"The selector of actions .* output has shape \(3, 5\), where \(3, 1\) is expected"):
        make_model(algorithm=type("Guarded", (GuardedAlgorithm, Selecting), {}))


def test_a_policy_that_cannot_be_copied_is_not_tried():
    class Uncopyable(Extractor):
        def __deepcopy__(self, memo):
            raise TypeError("this one is unique")

    make_model(Uncopyable).learn(20)


@pytest.mark.parametrize(
    ("actions", "elites", "message"),
    [
        (lambda n, d: th.zeros(n, d, dtype=th.float64), None, "its `actions` are torch.float64"),
        (lambda n, d: np.zeros((n, d), np.float32), None, "its `actions` are a ndarray"),
        (lambda n, d: th.full((n, d), th.nan), None, r"its `actions` are not within \[-1, 1\]"),
        (lambda n, d: th.full((n, d), 1.5), None, r"its `actions` are not within \[-1, 1\]"),
        (lambda n, d: th.zeros(n, d), lambda n, d: None, "its `elites` are a NoneType"),
        (lambda n, d: th.zeros(n, d), lambda n, d: th.zeros(n, d), r"its `elites` have shape \(3, 1\)"),
    ],
)
def test_a_selector_whose_selection_is_of_no_use_is_refused(actions, elites, message):
    class Own:
        def select(self, score, n_states, action_dim, device="cpu"):
            chosen = actions(n_states, action_dim)
            return Selection(chosen, th.zeros(n_states, 2, action_dim) if elites is None else elites(n_states, action_dim))

    with pytest.raises(ValueError, match=f"The selector of actions failed .*{message}.*`policy_kwargs\\['selector'\\]`"):
        CGP("MlpPolicy", "Pendulum-v1", buffer_size=10, policy_kwargs=dict(net_arch=[8], selector=Own()))


def test_networks_for_a_part_of_the_space_are_taken():
    class Embedded(BaseFeaturesExtractor):
        """Knows the first ten whole numbers only."""

        def __init__(self, space):
            super().__init__(space, 3)
            self.embedding = th.nn.Embedding(10, 3)

        def forward(self, observations):
            return self.embedding(observations[:, 0].long())

    class Counting(gym.Env):
        observation_space = spaces.Box(-100, 100, (1,), np.float32)
        action_space = ACTIONS

        def reset(self, *, seed=None, options=None):
            return np.zeros(1, np.float32), {}

        def step(self, action):
            return np.full(1, 9, np.float32), 0.0, True, False, {}

    kwargs = dict(net_arch=[4], features_extractor_class=Embedded)
    assert GuardedTD3("MlpPolicy", Counting(), **(SMALL | dict(policy_kwargs=kwargs))).learn(20)._n_updates == 14


@pytest.mark.parametrize(
    "compute_reward",
    [lambda self, achieved, desired, info: 1.0, lambda self, achieved, desired: np.ones(len(achieved))],
    ids=["one number", "two parameters"],
)
def test_rewards_of_goals_that_are_not_those_of_a_batch_are_refused(compute_reward):
    env = type("Goals", (Located,), dict(compute_reward=compute_reward))(goals=True)
    with pytest.raises(ValueError, match=r"`env.compute_reward` is .* must be able to return the rewards of a batch"):
        GuardedTD3("MultiInputPolicy", env, replay_buffer_class=HerReplayBuffer, **SMALL)


def test_goals_that_are_one_number_are_taken():
    env = BitFlippingEnv(n_bits=3, continuous=True, max_steps=3, discrete_obs_space=True)
    model = GuardedTD3("MultiInputPolicy", env, replay_buffer_class=HerReplayBuffer, **SMALL)
    assert model.learn(30)._n_updates > 0


@pytest.mark.parametrize("error", [KeyError("x"), TypeError("float() argument must be a string or a real number")])
@pytest.mark.parametrize("vec_env_class", [DummyVecEnv, SubprocVecEnv])
def test_rewards_that_need_more_than_empty_infos_are_not_refused(vec_env_class, error):
    class Needy(Located):
        def compute_reward(self, achieved, desired, info):
            raise error

    kwargs = dict(start_method="fork") if vec_env_class is SubprocVecEnv else {}
    env = vec_env_class([lambda: Needy(goals=True)], **kwargs)
    model = GuardedTD3("MultiInputPolicy", env, replay_buffer_class=HerReplayBuffer, **SMALL | dict(learning_starts=100))
    with pytest.warns(UserWarning, match="Nothing is learnt"):
        model.learn(5)
    env.close()


@pytest.mark.parametrize("rate", [np.array(1e-3), th.tensor([1e-3])], ids=["array", "tensor"])
def test_schedules_of_one_number_in_any_form_are_taken(rate):
    CGP("MlpPolicy", "Pendulum-v1", learning_rate=lambda progress: rate, buffer_size=10, policy_kwargs=dict(net_arch=[4]))


@pytest.mark.parametrize("value", [-1e-3, float("nan"), "1e-3"])
def test_schedules_of_no_learning_rate_are_refused(value):
    with pytest.raises(ValueError, match=r"`actor_learning_rate\(1.0\)` is .*, but must be a finite number >= 0"):
        CGP("MlpPolicy", "Pendulum-v1", actor_learning_rate=lambda progress: value, buffer_size=10)
