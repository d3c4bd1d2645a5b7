"""Tests of which networks behave differently in training mode, and of what is spared for the others."""

from copy import deepcopy

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from small_models import make_model
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor, NatureCNN
from stable_baselines3.td3.policies import Actor
from torch import nn

from sb3_cgp import CnnPolicy, MlpPolicy, MultiInputPolicy
from sb3_cgp.common.networks import MODELESS, evaluation_mode, has_modes, update_average

IMAGE = spaces.Box(0, 255, (3, 36, 36), np.uint8)
VECTOR = spaces.Box(-1, 1, (4,))
# How to make each kind of module, and its inputs
EXAMPLES = {
    nn.Sequential: (lambda: nn.Sequential(nn.Linear(4, 4)), (3, 4)),
    nn.Linear: (lambda: nn.Linear(4, 2), (3, 4)),
    nn.LayerNorm: (lambda: nn.LayerNorm(4), (3, 4)),
    nn.Conv2d: (lambda: nn.Conv2d(3, 2, 3), (3, 3, 8, 8)),
    FlattenExtractor: (lambda: FlattenExtractor(VECTOR), (3, 4)),
    NatureCNN: (lambda: NatureCNN(IMAGE), (3, 3, 36, 36)),
    **{kind: (kind, (3, 4)) for kind in (nn.Flatten, nn.ReLU, nn.LeakyReLU, nn.ELU, nn.GELU, nn.SiLU, nn.Tanh)},
}


class NoisyLinear(nn.Linear):
    def forward(self, inputs):
        return super().forward(inputs) + (th.randn(1) if self.training else 0)


def buffered(linear):
    linear.register_buffer("running_scale", th.ones(1))
    return linear


def patched(linear):
    usual = linear.forward
    linear.forward = lambda inputs: usual(inputs) * (2 if linear.training else 1)
    return linear


def hooked(linear):
    linear.register_forward_hook(lambda module, inputs, output: output * (2 if module.training else 1))
    return linear


@pytest.mark.parametrize("kind", EXAMPLES, ids=lambda kind: kind.__name__)
def test_modules_without_modes_compute_the_same_in_both_and_change_nothing(kind):
    make, shape = EXAMPLES[kind]
    module, inputs = make(), th.rand(shape)
    assert type(module) is kind
    assert not has_modes(module)
    state = deepcopy(module.state_dict())
    trained, evaluated = module.train()(inputs), module.eval()(inputs)
    assert th.equal(trained, evaluated)
    assert th.equal(module.train()(inputs), trained)
    assert all(th.equal(value, state[name]) for name, value in module.state_dict().items())


def test_every_kind_without_modes_has_an_example():
    # Networks of CGP and containers, which the test of whole policies sees
    assert set(EXAMPLES) | {Actor, ContinuousCritic, CombinedExtractor, nn.ModuleList, nn.ModuleDict} == MODELESS


@pytest.mark.parametrize(
    "module",
    [
        nn.Dropout(),
        nn.BatchNorm1d(2),
        nn.RReLU(),
        NoisyLinear(2, 2),
        hooked(nn.Linear(2, 2)),
        buffered(nn.Linear(2, 2)),
        patched(nn.Linear(2, 2)),
        nn.utils.spectral_norm(nn.Linear(2, 2)),
        nn.utils.parametrizations.spectral_norm(nn.Linear(2, 2)),
    ],
    ids=lambda module: type(module).__name__,
)
def test_a_network_has_modes_if_one_module_has(module):
    assert has_modes(module)
    model = make_model()
    for network in (model.actor, model.critic):
        assert not has_modes(network)
        network.features_extractor.flatten = nn.Sequential(nn.Flatten(), nn.Sequential(module))
        assert has_modes(network)


@pytest.mark.parametrize(
    ("policy_class", "space"),
    [(MlpPolicy, VECTOR), (CnnPolicy, IMAGE), (MultiInputPolicy, spaces.Dict(image=IMAGE, vector=VECTOR))],
)
@pytest.mark.parametrize("activation", [nn.ReLU, nn.Tanh, nn.ELU])
def test_the_usual_policies_have_no_modes(policy_class, space, activation):
    policy = policy_class(space, VECTOR, lambda progress: 1e-3, net_arch=[8], activation_fn=activation)
    for network in (policy.actor, policy.actor_target, policy.critic, policy.critic_target):
        assert not has_modes(network)


def test_a_spectral_norm_does_not_move_in_evaluation_mode():
    # Its hook moves a buffer at every call in training mode
    network = nn.Sequential(nn.utils.spectral_norm(nn.Linear(4, 4)), nn.ReLU()).train()
    direction = network[0].weight_u.clone()
    with evaluation_mode(network):
        network(th.rand(2, 4))
    assert th.equal(network[0].weight_u, direction)
    network(th.rand(2, 4))
    assert not th.equal(network[0].weight_u, direction)
    assert network[0].training


def test_averages_move_and_statistics_are_copied():
    networks = [nn.Sequential(nn.Linear(2, 2), nn.BatchNorm1d(2)), nn.Sequential(nn.Linear(2, 2), nn.ReLU())]
    for network in networks:
        average = deepcopy(network)
        network(th.rand(8, 2))
        with th.no_grad():
            network[0].weight += 1.0
        expected = average[0].weight + 0.25
        update_average(network, average, tau=0.25)
        assert th.allclose(average[0].weight, expected)
        for name, statistic in average.named_buffers():
            assert th.equal(statistic, network.get_buffer(name)) == name.startswith("1.running_")
