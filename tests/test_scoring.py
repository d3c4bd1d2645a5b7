"""The fast way of scoring many actions against the plain one, and both against a matrix product at a time."""

import oracles
import pytest
import torch as th
from stable_baselines3.common.torch_layers import create_mlp
from torch import nn

from sb3_cgp import scoring
from sb3_cgp.scoring import q_score, repeated_q_score

N_FEATURES, ACTION_DIM = 7, 3


def mlp(net_arch, activation_fn=nn.ReLU, **kwargs):
    th.manual_seed(0)
    return nn.Sequential(*create_mlp(N_FEATURES + ACTION_DIM, 1, net_arch, activation_fn, **kwargs)).eval()


NETWORKS = {
    "two hidden layers": mlp([32, 16]),
    "no hidden layer": mlp([]),
    "one hidden layer": mlp([8]),
    "three layers, tanh": mlp([16, 16, 16], nn.Tanh),
    "leaky rectifier": mlp([16], nn.LeakyReLU),
    "without bias": mlp([16, 16], with_bias=False),
    "layer norm and dropout": nn.Sequential(
        nn.Linear(10, 16), nn.LayerNorm(16), nn.ReLU(), nn.Dropout(0.5), nn.Linear(16, 1)
    ).eval(),
    "batch norm": nn.Sequential(nn.Linear(10, 16), nn.BatchNorm1d(16), nn.ReLU(), nn.Linear(16, 1)).eval(),
    "batch norm first": nn.Sequential(nn.BatchNorm1d(10), nn.Linear(10, 1)).eval(),
    "not sequential": nn.Linear(10, 1),
}


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize(("n_states", "n_actions"), [(1, 1), (5, 9), (64, 33)])
@pytest.mark.parametrize("block_size", [1, 200, scoring.BLOCK_SIZE])
@th.no_grad()
def test_fast_and_plain_scores_agree(monkeypatch, name, n_states, n_actions, block_size):
    monkeypatch.setattr(scoring, "BLOCK_SIZE", block_size)
    features = th.randn(n_states, N_FEATURES)
    actions = th.rand(n_states, n_actions, ACTION_DIM) * 2 - 1
    fast = q_score(NETWORKS[name], features)(actions)
    plain = repeated_q_score(NETWORKS[name], features)(actions)
    assert fast.shape == (n_states, n_actions)
    th.testing.assert_close(fast, plain, rtol=1e-4, atol=1e-5)


@th.no_grad()
def test_scores_are_those_of_the_network_row_by_row():
    network = NETWORKS["two hidden layers"]
    layers = [layer for layer in network if isinstance(layer, nn.Linear)]
    features = th.randn(4, N_FEATURES)
    actions = th.rand(4, 6, ACTION_DIM) * 2 - 1
    scores = q_score(network, features)(actions)
    for state in range(4):
        for index in range(6):
            inputs = th.cat([features[state], actions[state, index]])
            expected = oracles.perceptron([layer.weight for layer in layers], [layer.bias for layer in layers], inputs)
            assert scores[state, index].item() == pytest.approx(expected.item(), abs=1e-5)


@th.no_grad()
def test_scoring_changes_neither_its_inputs_nor_the_network():
    network = NETWORKS["two hidden layers"]
    features, actions = th.randn(4, N_FEATURES), th.rand(4, 6, ACTION_DIM)
    before = [tensor.clone() for tensor in (features, actions, *network.parameters())]
    score = q_score(network, features)
    assert th.equal(score(actions), score(actions))
    for old, new in zip(before, (features, actions, *network.parameters()), strict=True):
        assert th.equal(old, new)
