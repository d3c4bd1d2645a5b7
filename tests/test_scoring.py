"""The fast way of scoring many actions against the plain one, and both against a matrix product at a time."""

import platform
import subprocess
import sys
from types import SimpleNamespace

import oracles
import pytest
import torch as th
from stable_baselines3.common.torch_layers import create_mlp
from torch import nn

from sb3_cgp.core.policies import repeated_q_score
from sb3_cgp.fast import linear as products
from sb3_cgp.fast import scoring
from sb3_cgp.fast.scoring import q_score

N_FEATURES, ACTION_DIM = 7, 3


def mlp(net_arch, activation_fn=nn.ReLU, **kwargs):
    th.manual_seed(0)
    return nn.Sequential(*create_mlp(N_FEATURES + ACTION_DIM, 1, net_arch, activation_fn, **kwargs)).eval()


NETWORKS = {
    "two hidden layers": mlp([32, 16]),
    "no hidden layer": mlp([]),
    "one hidden layer": mlp([8]),
    "three layers, tanh": mlp([16, 16, 16], nn.Tanh),
    "leaky ReLU": mlp([16], nn.LeakyReLU),
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
@pytest.mark.parametrize("block_bytes", [1, 400, scoring.BLOCK_BYTES])
@pytest.mark.parametrize("with_onednn", [True, False])
@th.no_grad()
def test_fast_and_plain_scores_agree(monkeypatch, name, n_states, n_actions, block_bytes, with_onednn):
    monkeypatch.setattr(scoring, "BLOCK_BYTES", block_bytes)
    monkeypatch.setattr(products, "MANY_MULTIPLICATIONS", 1 if with_onednn else th.inf)
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
            expected = oracles.mlp([layer.weight for layer in layers], [layer.bias for layer in layers], inputs)
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


def rounded_differences(network, features, actions):
    """
    The network a state at a time in float64, save for what an action's activations differ by from those of the state's mean
    action. To bfloat16 are rounded: that difference, wherever a layer takes or gives it, the weights that it is multiplied
    by, and how far from zero the mean action's activations are in the first layer.
    """

    def rounded(tensor):
        return tensor.bfloat16().double()

    def apply(layer, inputs):
        return oracles.mlp([layer.weight], [layer.bias], inputs)

    first, *hidden_layers, last = [layer for layer in network if isinstance(layer, nn.Linear)]
    action_weight = rounded(first.weight[:, N_FEATURES:])
    scores = th.empty(actions.shape[:2])
    for state, of_state in enumerate(actions):
        mean_action = of_state.mean(dim=0)
        common = apply(first, th.cat([features[state], mean_action]))
        from_zero = rounded(common)
        differences = [
            (rounded(action_weight @ rounded(action - mean_action) + from_zero.clamp(max=0.0))).maximum(
                -from_zero.clamp(min=0.0)
            )
            for action in of_state
        ]
        for layer in hidden_layers:
            common = apply(layer, common.clamp(min=0.0))
            rows = [common + rounded(rounded(layer.weight) @ difference) for difference in differences]
            differences = [rounded(row.clamp(min=0.0) - common.clamp(min=0.0)) for row in rows]
        scores[state] = th.cat([apply(last, row.clamp(min=0.0)) for row in rows])
    return scores


@pytest.mark.parametrize("with_onednn", [True, False])
@pytest.mark.parametrize("net_arch", [[32, 16], [32, 64, 16], [64, 64, 64, 64]])
@th.no_grad()
def test_bfloat16_rounds_what_its_definition_says_and_nothing_else(monkeypatch, with_onednn, net_arch):
    # Or for all products, however small
    monkeypatch.setattr(products, "MANY_MULTIPLICATIONS", 1 if with_onednn else th.inf)
    network = mlp(net_arch)
    features = th.randn(scoring.MANY_STATES, N_FEATURES)
    actions = th.rand(scoring.MANY_STATES, 6, ACTION_DIM) * 2 - 1
    # Few states are scored in float32
    few = slice(scoring.MANY_STATES - 1)
    assert th.equal(*(q_score(network, features[few], dtype)(actions[few]) for dtype in (th.float32, th.bfloat16)))
    scores = q_score(network, features, th.bfloat16)(actions)
    exact = repeated_q_score(network, features)(actions)
    assert scores.dtype == th.float32
    th.testing.assert_close(scores, rounded_differences(network, features, actions), rtol=0.0, atol=5e-6)
    # It does round
    assert (scores - exact).abs().max() > 4e-5


@th.no_grad()
def test_bfloat16_ranks_actions_that_differ_little_from_one_another():
    network = mlp([64, 64])
    # Large activations, which bfloat16 itself would round by far more than the actions change them
    network[0].bias += 50.0
    features = th.randn(32, N_FEATURES)
    actions = th.rand(32, 1, ACTION_DIM) + 0.01 * th.randn(32, 64, ACTION_DIM)
    exact, scores = (q_score(network, features, dtype)(actions) for dtype in (th.float32, th.bfloat16))
    elites, others = (values.topk(6, dim=1).indices for values in (exact, scores))
    assert (elites.unsqueeze(2) == others.unsqueeze(1)).any(dim=2).float().mean() > 0.9


@th.no_grad()
def test_networks_with_hooks_are_called_as_they_are():
    network = mlp([16, 16])
    network[2].register_forward_hook(lambda layer, inputs, output: 2 * output)
    features, actions = th.randn(4, N_FEATURES), th.rand(4, 6, ACTION_DIM)
    th.testing.assert_close(q_score(network, features)(actions), repeated_q_score(network, features)(actions))


@pytest.mark.parametrize("name", NETWORKS)
@th.no_grad()
def test_bfloat16_is_close_for_any_network_and_rounds_only_relu_networks(name):
    network = NETWORKS[name]
    features = th.randn(16, N_FEATURES)
    actions = th.rand(16, 9, ACTION_DIM) * 2 - 1
    scores = q_score(network, features, th.bfloat16)(actions)
    exact = q_score(network, features)(actions)
    th.testing.assert_close(scores, exact, rtol=0.05, atol=0.05)
    has_rounded = not th.equal(scores, exact)
    assert has_rounded == (name in ("two hidden layers", "without bias"))


@pytest.mark.parametrize(
    ("setting", "capabilities", "dtype"),
    [
        ("auto", {"avx512_bf16": True, "cpu_name": "AMD EPYC"}, th.bfloat16),
        ("auto", {"avx512_bf16": True}, th.bfloat16),
        ("auto", {"avx512_bf16": True, "amx_bf16": True, "cpu_name": "Intel Xeon"}, th.bfloat16),
        ("auto", {"avx512_bf16": False, "amx_bf16": True}, th.bfloat16),
        # An Intel processor whose AMX the virtual machine hides
        ("auto", {"avx512_bf16": True, "amx_bf16": False, "cpu_name": "Intel Xeon"}, th.float32),
        ("auto", {"avx512_f": True}, th.float32),
        ("auto", None, th.float32),
        ("float32", {"avx512_bf16": True}, th.float32),
        ("bfloat16", {}, th.bfloat16),
    ],
)
def test_auto_is_bfloat16_where_the_processor_multiplies_it_faster(monkeypatch, setting, capabilities, dtype):
    if capabilities is None:
        # An older PyTorch
        monkeypatch.delattr(th.cpu, "get_capabilities", raising=False)
    else:
        monkeypatch.setattr(th.cpu, "get_capabilities", lambda: capabilities, raising=False)
    assert scoring.scoring_dtype(setting, th.device("cpu")) == dtype


def test_auto_is_float32_on_a_gpu(monkeypatch):
    monkeypatch.setattr(th.cpu, "get_capabilities", lambda: {"avx512_bf16": True}, raising=False)
    assert scoring.scoring_dtype("auto", th.device("cuda")) == th.float32


@pytest.mark.parametrize("reason", ["no oneDNN", "no such function", "not on this processor"])
def test_without_onednn_scores_are_the_same(monkeypatch, reason):
    def refuse(*args):
        raise RuntimeError("could not create a primitive descriptor")

    if reason == "no oneDNN":
        monkeypatch.setattr(th.backends.mkldnn, "is_available", lambda: False)
    else:
        functions = SimpleNamespace() if reason == "no such function" else SimpleNamespace(_linear_pointwise=refuse)
        monkeypatch.setattr(th.ops, "mkldnn", functions)
    monkeypatch.setattr(products, "MANY_MULTIPLICATIONS", 1)
    products._probe_onednn_linear.cache_clear()
    try:
        assert products.onednn_linear(th.float32) is None
        features, actions = th.randn(4, N_FEATURES), th.rand(4, 6, ACTION_DIM)
        for network in (NETWORKS["two hidden layers"], NETWORKS["three layers, tanh"]):
            th.testing.assert_close(q_score(network, features)(actions), repeated_q_score(network, features)(actions))
    finally:
        products._probe_onednn_linear.cache_clear()


def test_onednn_that_is_disabled_is_not_called(monkeypatch):
    if products.onednn_linear(th.float32) is None:
        pytest.skip("no oneDNN")
    called = []
    probe = products._probe_onednn_linear
    monkeypatch.setattr(products, "_probe_onednn_linear", lambda dtype: called.append(dtype) or probe(dtype))
    monkeypatch.setattr(products, "MANY_MULTIPLICATIONS", 1)
    inputs, weight, bias = th.randn(8, 4), th.randn(5, 4), th.randn(5)
    expected = products.multiply(inputs, weight, bias)
    assert len(called) == 1
    with th.backends.mkldnn.flags(enabled=False):
        th.testing.assert_close(products.multiply(inputs, weight, bias), expected)
    assert len(called) == 1
    products.multiply(inputs, weight, bias)
    assert len(called) == 2


def test_the_private_function_exists_in_the_tested_pytorch():
    # Without it everything works, but no faster than MKL: the constraints' PyTorch should have it
    assert products.onednn_linear(th.float32) is not None or not th.backends.mkldnn.is_available()


COUNT_FRESH_PAGES = """
import resource
import torch as th
from stable_baselines3.common.torch_layers import create_mlp
from sb3_cgp import CEM
from sb3_cgp.fast.scoring import q_score

th.set_num_threads(2)
network, features = th.nn.Sequential(*create_mlp(23, 1, [256, 256])), th.randn(128, 17)
for dtype in (th.float32, th.bfloat16):
    with th.no_grad():
        for call in range(14):
            if call == 6:
                before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
            CEM().select(q_score(network, features, dtype), 128, 6)
    print((resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before) / 8)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries keep freed memory in their own way")
def test_calls_take_no_fresh_memory_from_the_system():
    # In a process of its own, as what is kept depends on all that a process has freed. A block of activations has 512 pages,
    # and two of the eight calls may still take one, 128 pages a call, until the heap has grown to what it needs
    counts = subprocess.run([sys.executable, "-c", COUNT_FRESH_PAGES], check=True, capture_output=True, text=True).stdout
    assert all(float(count) < 256 for count in counts.split())
    assert len(counts.split()) == 2


@th.no_grad()
def test_comparing_as_integers_is_comparing_numbers():
    values = th.tensor([0.0, -0.0, 1e-30, -1e-30, 0.5, -0.5, 3.0, -3.0, 1e30, -1e30, th.inf, -th.inf])
    ceilings = th.tensor([0.0, -0.0, 1e-30, 0.5, 3.0, th.inf])
    for ceiling in ceilings.bfloat16():
        lowered = scoring._clip_above(values.bfloat16().view(-1, 1), ceiling.abs().view(1, 1, 1))
        assert lowered.flatten().tolist() == [min(value, ceiling.item()) for value in values.bfloat16().tolist()]
