"""The selector chooses actions by the values that the critic learns, or the model is refused."""

import numpy as np
import pytest
import torch as th
from guarded import SMALL, Located, located
from gymnasium import spaces
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.vec_env import DummyVecEnv
from torch import nn

from sb3_cgp import CGP, MlpPolicy
from sb3_cgp.selectors import ActorOnly


class Mirroring(ContinuousCritic):
    """Learns values of the actions with the other sign."""

    def forward(self, obs, actions):
        features = self.extract_features(obs, self.features_extractor)
        return tuple(q_network(th.cat([features, -actions], dim=1)) for q_network in self.q_networks)

    def q1_forward(self, obs, actions):
        return self(obs, actions)[0]


class Amplifying(ContinuousCritic):
    """Scales features, which are zeros for an observation of zeros."""

    def extract(self, obs):
        return 3.0 * self.extract_features(obs, self.features_extractor)

    def forward(self, obs, actions):
        return tuple(q_network(th.cat([self.extract(obs), actions], dim=1)) for q_network in self.q_networks)

    def q1_forward(self, obs, actions):
        return self(obs, actions)[0]


def policy_with(critic_class):
    class Policy(MlpPolicy):
        def make_critic(self, features_extractor=None):
            return critic_class(**self._update_features_extractor(self.critic_kwargs, features_extractor)).to(self.device)

    return Policy


@pytest.mark.parametrize("critic", [Mirroring, Amplifying])
@pytest.mark.parametrize("cem_dtype", ["float32", "bfloat16"])
def test_a_critic_of_other_values_than_the_selectors_is_refused_and_the_remedy_named(critic, cem_dtype):
    with pytest.raises(ValueError, match=rf"`{critic.__name__}.forward` returns .* Override `make_score\(.*`Policy`"):
        CGP(policy_with(critic), located(), cem_dtype=cem_dtype, **SMALL)


def test_the_remedy_lets_the_selector_choose_by_the_critics_values():
    class Policy(policy_with(Mirroring)):
        def make_score(self, q_network, features):
            score = super().make_score(q_network, features)
            return lambda actions: score(-actions)

    policy = CGP(Policy, located(), **SMALL).policy
    observations = th.rand(5, 2)
    best = policy.critic(observations, policy.select_actions(observations, policy.critic).actions)[0]
    others = [policy.critic(observations, th.full((5, 1), value))[0] for value in np.linspace(-0.9, 0.9, 7)]
    assert (best > th.stack(others).mean(dim=0)).all()


class InBfloat16(ContinuousCritic):
    """Trains in mixed precision, and returns values of either data type."""

    dtype = th.float32

    def forward(self, obs, actions):
        with th.autocast("cpu", dtype=th.bfloat16):
            return tuple(values.to(self.dtype) for values in super().forward(obs, actions))


class ReturningBfloat16(InBfloat16):
    dtype = th.bfloat16


class OfTheMinimum(ContinuousCritic):
    """Lets the actor's loss use the minimum of the critics."""

    def q1_forward(self, obs, actions):
        return th.cat(self(obs, actions), dim=1).min(dim=1, keepdim=True).values


@pytest.mark.parametrize("critic", [InBfloat16, ReturningBfloat16, OfTheMinimum])
def test_values_may_be_rounded_and_the_actors_loss_may_use_others(critic):
    CGP(policy_with(critic), located(), policy_loss="qgp", **SMALL).learn(9)


def test_a_selector_that_scores_nothing_takes_any_critic():
    policy_kwargs = dict(net_arch=[4], selector=ActorOnly())
    CGP(policy_with(Mirroring), located(), policy_loss="qgp", **SMALL | dict(policy_kwargs=policy_kwargs)).learn(9)


class Normalised(FlattenExtractor):
    """Has all that differs between training and evaluation, or between two calls."""

    def __init__(self, observation_space):
        super().__init__(observation_space)
        linear = nn.utils.parametrizations.spectral_norm(nn.Linear(self.features_dim, self.features_dim))
        self.layers = nn.Sequential(linear, nn.BatchNorm1d(self.features_dim), nn.Dropout(0.5))

    def forward(self, observations):
        features = self.layers(super().forward(observations))
        return features + th.rand_like(features)


class Regularised(ContinuousCritic):
    """A critic of networks with layers of all kinds, which is evaluated as SB3's."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        for index, (first, *others) in enumerate(self.q_networks):
            width = first.out_features
            layers = nn.utils.spectral_norm(first), nn.BatchNorm1d(width), nn.LayerNorm(width), nn.Dropout(0.5)
            self.q_networks[index] = nn.Sequential(*layers, *others)


@pytest.mark.parametrize("cem_dtype", ["float32", "bfloat16"])
@pytest.mark.parametrize(
    "policy_kwargs",
    [
        dict(n_critics=1),
        dict(n_critics=3, activation_fn=nn.Tanh),
        dict(net_arch=[4, 4, 4], features_extractor_class=Normalised),
        dict(features_extractor_class=Normalised, share_features_extractor=True),
        dict(net_arch=[]),
    ],
    ids=str,
)
def test_critics_of_sb3s_policies_are_taken(policy_kwargs, cem_dtype):
    for policy in ("MlpPolicy", policy_with(Regularised) if policy_kwargs.get("net_arch") != [] else MlpPolicy):
        CGP(policy, located(), cem_dtype=cem_dtype, **SMALL | dict(policy_kwargs=dict(net_arch=[8, 8]) | policy_kwargs))


@pytest.mark.parametrize(
    ("policy", "space"),
    [
        ("CnnPolicy", spaces.Box(0, 255, (3, 36, 36), np.uint8)),
        ("MlpPolicy", spaces.Box(-np.inf, np.inf, (2, 3), np.float64)),
        ("MlpPolicy", spaces.Box(-3e38, 3e38, (2,), np.float32)),
        ("MlpPolicy", spaces.Discrete(4)),
        ("MultiInputPolicy", spaces.Dict(a=spaces.Box(-1, 1, (1,)), b=spaces.Box(0, 255, (3, 36, 36), np.uint8))),
    ],
    ids=str,
)
def test_critics_of_observations_of_every_kind_are_taken(policy, space):
    env = Located()
    env.observation_space, env.observe = space, space.sample
    CGP(policy, DummyVecEnv([lambda: env]), **SMALL | dict(buffer_size=20, policy_kwargs=dict(net_arch=[4, 4])))
