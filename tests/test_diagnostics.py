"""Measurements leave a training as it is: diagnostics of networks whose mode matters, and all random generators."""

import random

import numpy as np
import torch as th
from small_models import make_model, same_parameters
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

from sb3_cgp.common.random_state import preserved_random_state


class Normalizing(BaseFeaturesExtractor):
    """Keeps statistics in training mode, and drops features at random."""

    def __init__(self, observation_space):
        super().__init__(observation_space, 3)
        self.layers = th.nn.Sequential(th.nn.BatchNorm1d(3), th.nn.Dropout(0.2))

    def forward(self, observations):
        return self.layers(observations)


def test_diagnostics_change_no_statistics_of_batch_norm():
    kwargs = dict(net_arch=[16], features_extractor_class=Normalizing)
    # 120 gradient steps, of which the hundredth is diagnosed
    models = [make_model(diagnostics=diagnostics, policy_kwargs=kwargs).learn(170) for diagnostics in (True, False)]
    assert ["train/actor_cem_distance" in model.logger.name_to_value for model in models] == [True, False]
    assert same_parameters(*models)


def test_a_measurement_draws_from_no_generator():
    def draw():
        return random.random(), np.random.random(), th.rand(1).item()  # noqa: NPY002

    with preserved_random_state(th.device("cpu")):
        drawn = draw()
    assert draw() == drawn
