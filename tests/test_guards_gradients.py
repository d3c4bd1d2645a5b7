"""Where PyTorch's gradients are off, models are made, loaded and act, and no training pretends to train."""

import numpy as np
import pytest
import torch as th
from guarded import SMALL, GuardedTD3, located, make
from stable_baselines3.common.torch_layers import FlattenExtractor

from sb3_cgp import CGP, TrainingCheckpointCallback
from sb3_cgp.population import Population

OFF = {"no_grad": th.no_grad, "inference_mode": th.inference_mode}
OBSERVATION = np.zeros(3, np.float32)


@pytest.fixture(params=OFF.values(), ids=OFF)
def gradients_off(request):
    return request.param


def test_a_model_is_made_loaded_and_resumed_to_act(gradients_off, tmp_path):
    model = make().learn(20, TrainingCheckpointCallback(10, tmp_path / "state"))
    model.save(tmp_path / "model")
    expected = model.predict(OBSERVATION)[0]
    fresh = make().predict(OBSERVATION)[0]
    with gradients_off():
        assert make().predict(OBSERVATION)[0] == fresh
        assert CGP.load(tmp_path / "model").predict(OBSERVATION)[0] == expected
        assert CGP.resume(tmp_path / "state", "Pendulum-v1").predict(OBSERVATION)[0] == expected


def test_a_population_is_loaded_to_act(gradients_off, tmp_path):
    population = Population("MlpPolicy", "Pendulum-v1", agents=2, **SMALL)
    population.save(tmp_path / "population")
    expected = population.predict(np.tile(OBSERVATION, (2, 1)))[0]
    with gradients_off():
        loaded = Population.load(tmp_path / "population")
        np.testing.assert_array_equal(loaded.predict(np.tile(OBSERVATION, (2, 1)))[0], expected)


class InPlace(FlattenExtractor):
    """Works without gradients, and not with them."""

    def __init__(self, space):
        super().__init__(space)
        self.weight = th.nn.Parameter(th.ones(self.features_dim))

    def forward(self, observations):
        features = th.sigmoid(super().forward(observations) * self.weight)
        product = features * features
        features += 1
        return product


def test_networks_that_cannot_learn_are_refused_there_too(gradients_off):
    with gradients_off(), pytest.raises(ValueError, match=r"The actor cannot learn from .* modified by an inplace operation"):
        make(env=located(), policy_kwargs=dict(features_extractor_class=InPlace))


TRAININGS = {
    "CGP": lambda model: model.learn(20),
    "TD3": lambda model: model.learn(20),
    "train_policy": lambda model: model.train_policy(),
}


@pytest.mark.parametrize("name", TRAININGS)
def test_a_training_is_refused_there_and_the_model_stays_as_it_is(gradients_off, name):
    model = make(algorithm=GuardedTD3 if name == "TD3" else CGP).learn(10)
    before = {key: value.clone() for key, value in model.policy.state_dict().items()}
    with gradients_off(), pytest.raises(ValueError, match=r"`torch.is_grad_enabled\(\)` is False, but must be True to train"):
        TRAININGS[name](model)
    assert model.num_timesteps == 10
    assert all(th.equal(value, before[key]) for key, value in model.policy.state_dict().items())


def test_a_model_that_was_made_for_inference_says_why_it_cannot_train():
    with th.inference_mode():
        model = make()
    with pytest.raises(ValueError, match=r"must be False to train: make or load the model outside of `torch.inference_mode"):
        model.learn(20)


def test_an_actor_that_is_frozen_is_not_trained_offline(monkeypatch):
    monkeypatch.setattr("sb3_cgp.core.offline.ROUND", 2)
    model = make(policy_training="offline")
    model.actor.requires_grad_(False)
    message = r"`actor.requires_grad` is False, but must be True .* offline: call `model.actor.requires_grad_\(True\)`"
    with pytest.raises(ValueError, match=message):
        model.learn(20)
    assert model.num_timesteps == 0
    model.actor.requires_grad_(True)
    model.learn(20)
    model.actor.requires_grad_(False)
    with pytest.raises(ValueError, match=message):
        model.train_policy()
    # A part of it may be
    model.actor.mu[-2].requires_grad_(True)
    model.train_policy(max_steps=4)
