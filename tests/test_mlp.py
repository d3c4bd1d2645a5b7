"""MLPs against PyTorch's own sequence of the same modules, values and gradients alike."""

import copy

import pytest
import torch as th
from stable_baselines3 import TD3
from stable_baselines3.common.torch_layers import create_mlp
from torch import nn

from sb3_cgp import CGP
from sb3_cgp.fast import linear as products
from sb3_cgp.fast.mlp import MANY_ROWS, MLP

N_INPUTS = 11


@pytest.fixture(autouse=True)
def _elsewhere_than_on_intel(monkeypatch):
    """On Intel's processors the networks are PyTorch's."""
    monkeypatch.setattr(products, "is_intel", lambda: False)


def modules(net_arch, activation_fn=nn.ReLU, **kwargs):
    th.manual_seed(0)
    return create_mlp(N_INPUTS, 2, net_arch, activation_fn, **kwargs)


NETWORKS = {
    # Large enough for oneDNN, and not
    "wide": modules([256, 192]),
    "narrow": modules([8, 16, 4]),
    "actor": modules([256, 256], squash_output=True),
    "no hidden layer": modules([]),
    "without bias": modules([160, 128], with_bias=False),
    "another activation": modules([16, 16], nn.Tanh),
    "batch norm": [nn.Linear(N_INPUTS, 8), nn.BatchNorm1d(8), nn.ReLU(), nn.Linear(8, 2)],
    "two ReLU": [nn.Linear(N_INPUTS, 8), nn.ReLU(), nn.ReLU(), nn.Linear(8, 2)],
    "ends with ReLU": [nn.Linear(N_INPUTS, 8), nn.ReLU()],
    "empty": [],
}


def outcome(network, inputs):
    """What a network gives, and the gradients by its inputs and parameters."""
    inputs = inputs.clone().requires_grad_()
    outputs = network(inputs)
    (outputs.sin() * th.arange(1.0, outputs.shape[1] + 1)).sum().backward()
    return [outputs, inputs.grad, *(parameter.grad for parameter in network.parameters())]


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize("rows", [1, MANY_ROWS, 200])
@pytest.mark.parametrize("with_onednn", [True, False])
def test_values_and_gradients_are_those_of_the_sequence(monkeypatch, name, rows, with_onednn):
    # Or for all products, however small
    monkeypatch.setattr(products, "MANY_MULTIPLICATIONS", 1 if with_onednn else th.inf)
    network = MLP(*copy.deepcopy(NETWORKS[name]))
    # Batch norm takes no batch of one for training
    network.train(rows > 1)
    # In float64, by PyTorch alone
    twin = nn.Sequential(*copy.deepcopy(list(network))).double()
    inputs = th.randn(rows, N_INPUTS)
    for ours, theirs in zip(outcome(network, inputs), outcome(twin, inputs.double()), strict=True):
        assert ours.dtype == th.float32
        th.testing.assert_close(ours.double(), theirs, rtol=1e-4, atol=1e-4)


def test_only_the_gradients_that_are_needed_are_given():
    network = MLP(*copy.deepcopy(NETWORKS["wide"])).requires_grad_(False)
    network[2].weight.requires_grad_()
    inputs = th.randn(MANY_ROWS, N_INPUTS)
    network(inputs).sum().backward()
    assert [parameter.grad is not None for parameter in network.parameters()] == [False, False, True, False, False, False]
    assert inputs.grad is None
    with th.no_grad():
        assert not network(inputs).requires_grad


@pytest.mark.parametrize("kind", ["forward", "pre-forward", "backward", "pre-backward"])
def test_hooks_are_called(kind):
    called = []
    network = MLP(*copy.deepcopy(NETWORKS["wide"]))
    register = {
        "forward": network[2].register_forward_hook,
        "pre-forward": network[2].register_forward_pre_hook,
        "backward": network[2].register_full_backward_hook,
        "pre-backward": network[2].register_full_backward_pre_hook,
    }[kind]
    register(lambda *args: called.append(kind))
    network(th.randn(MANY_ROWS, N_INPUTS)).sum().backward()
    assert called == [kind]


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize("rows", [MANY_ROWS - 1, MANY_ROWS])
def test_second_derivatives_are_those_of_the_sequence(name, rows):
    """Also where the incoming gradient is constant, as in a gradient penalty."""

    def penalised(network, inputs):
        inputs = inputs.clone().requires_grad_()
        outputs = network(inputs)
        (slopes,) = th.autograd.grad(outputs.sum(), inputs, create_graph=True)
        (outputs.sin().sum() + slopes.square().sum()).backward()
        return [slopes, inputs.grad, *(parameter.grad for parameter in network.parameters())]

    network = MLP(*copy.deepcopy(NETWORKS[name])).eval()
    twin = nn.Sequential(*copy.deepcopy(list(network))).double()
    inputs = th.randn(rows, N_INPUTS)
    for ours, theirs in zip(penalised(network, inputs), penalised(twin, inputs.double()), strict=True):
        th.testing.assert_close(ours.double(), theirs, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("is_shared", [True, False])
def test_derivatives_of_parameters_that_occur_twice_are_those_of_the_sequence(is_shared):
    """In one network, or in a network that is applied to its own outputs."""
    layers = modules([N_INPUTS] if is_shared else [160, 128])
    first = layers[0]
    first, last = (first, first) if is_shared else (first, nn.Linear(layers[-1].in_features, N_INPUTS))
    network = MLP(first, *layers[1:-1], last)
    twin = copy.deepcopy(nn.Sequential(*network)).double()
    inputs = th.randn(MANY_ROWS, N_INPUTS)

    def derivatives(network, inputs):
        outputs = network(network(inputs)).sin().sum()
        firsts = th.autograd.grad(outputs, list(network.parameters()), create_graph=True)
        return [*firsts, *th.autograd.grad(sum(each.square().sum() for each in firsts), list(network.parameters()))]

    for ours, theirs in zip(derivatives(network, inputs), derivatives(twin, inputs.double()), strict=True):
        th.testing.assert_close(ours.double(), theirs, rtol=1e-3, atol=1e-3)


def test_on_intels_processors_the_networks_are_pytorchs(monkeypatch):
    network, inputs = MLP(*copy.deepcopy(NETWORKS["wide"])), th.randn(256, N_INPUTS)
    assert "ReLULayers" in network(inputs).grad_fn.name()
    monkeypatch.setattr(products, "is_intel", lambda: True)
    assert "ReLULayers" not in network(inputs).grad_fn.name()
    assert th.equal(network(inputs), nn.Sequential(*network)(inputs))


def test_autocast_is_pytorchs():
    network, inputs = MLP(*copy.deepcopy(NETWORKS["wide"])), th.randn(256, N_INPUTS)
    with th.autocast("cpu", dtype=th.bfloat16):
        outputs = network(inputs)
    assert outputs.dtype == th.bfloat16
    outputs.float().sum().backward()
    assert network[0].weight.grad is not None


@pytest.mark.parametrize("where", ["inputs", "weight"])
def test_nan_is_passed_on(where):
    network, inputs = MLP(*copy.deepcopy(NETWORKS["wide"])), th.randn(256, N_INPUTS)
    with th.no_grad():
        (inputs if where == "inputs" else network[2].weight)[:] = th.nan
        assert network(inputs).isnan().all()


@th.no_grad()
def test_tracing_sees_the_modules():
    network, inputs = MLP(*copy.deepcopy(NETWORKS["wide"])), th.randn(MANY_ROWS, N_INPUTS)
    traced = th.jit.trace(network, inputs)
    assert "aten::linear" in str(traced.inlined_graph)
    assert "_linear_pointwise" not in str(traced.inlined_graph)
    exported = th.export.export(network, (inputs,))
    assert "_linear_pointwise" not in str(exported.graph)
    th.testing.assert_close(exported.module()(inputs), network(inputs))


def test_parameters_have_the_names_that_td3_gives_them():
    arguments = dict(env="Pendulum-v1", policy_kwargs=dict(net_arch=[16, 16]), seed=0, buffer_size=10)
    model, td3 = CGP("MlpPolicy", **arguments), TD3("MlpPolicy", **arguments)
    assert [name for name, _ in model.policy.named_parameters()] == [name for name, _ in td3.policy.named_parameters()]
    networks = [model.actor.mu, model.actor_target.mu, *model.critic.q_networks, *model.critic_target.q_networks]
    assert all(type(network) is MLP for network in networks)
    # The critics' list and their modules are the same
    model.policy.load_state_dict(td3.policy.state_dict())
    observations, actions = th.randn(40, 3), th.rand(40, 1)
    for ours, theirs in zip(model.critic(observations, actions), td3.critic(observations, actions), strict=True):
        th.testing.assert_close(ours, theirs)
