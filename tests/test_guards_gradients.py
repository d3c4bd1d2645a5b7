"""Where PyTorch's gradients are off: models are made, loaded and act."""

import numpy as np
import pytest
import torch as th
from guarded import SMALL, located, make
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
    with gradients_off(), pytest.raises(ValueError, match="The actor cannot learn from .* modified by an inplace operation"):
        make(env=located(), policy_kwargs=dict(features_extractor_class=InPlace))
