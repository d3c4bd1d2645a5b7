"""``python -m benchmark.selector``: the operations that it counts, and what it writes. Times themselves are not tested."""

import numpy as np
import pytest
import torch as th
from measuring_commands import CPU, run_command
from tables import unpadded

from benchmark.speed import cem_calls, products
from benchmark.speed.products import LIGHT, Sizes
from sb3_cgp.core.policies import repeated_q_score


def test_operations_agree_with_a_count_by_hand():
    sizes = Sizes(batch=3, samples=5, iterations=2, action_dim=2, width=4, n_features=7)
    # Once per state 7 x 4, for each of 2 x 15 actions 2 x 4 + 4 x 4 + 4 x 1; a multiplication and an addition each
    assert products.call_flops(sizes) == 2 * (3 * 28 + 30 * 28)
    assert products.product_flops(sizes) == 2 * 30 * 16
    # The two big products of the default call
    assert products.product_flops(Sizes()) == 2 * 2 * 8192 * 256 * 256


@pytest.mark.parametrize("batch", [100, 6000])
def test_bare_products_do_the_operations_that_are_counted(monkeypatch, batch):
    sizes = Sizes(batch=batch, samples=1, iterations=3, width=4)
    counted = []

    def multiply(left, weight, result):
        assert (left.dtype, weight.dtype) == (th.bfloat16, th.bfloat16)
        assert weight.shape == (4, 4)
        counted.append(2 * left.shape[0] * left.shape[1] * weight.shape[0])

    monkeypatch.setattr(products, "kernels", lambda device, dtype: {"kernel": multiply})
    ways = products.bare_products(sizes, th.bfloat16, CPU)
    assert len(ways) == (1 if batch == 100 else 4)
    for run in ways.values():
        counted.clear()
        run()
        assert sum(counted) == products.product_flops(sizes)


@pytest.mark.parametrize("dtype", [th.float32, th.bfloat16])
def test_every_kernel_multiplies_by_the_transposed_weights(dtype):
    left, weight, result = th.randn(5, 8).to(dtype), th.randn(8, 8).to(dtype), th.empty(5, 8, dtype=dtype)
    for name, multiply in products.kernels(CPU, dtype).items():
        product = multiply(left, weight, result)
        th.testing.assert_close(product.float(), left.float() @ weight.float().t(), rtol=1e-2, atol=1e-1, msg=name)


def test_kernels_leave_out_those_that_the_processor_lacks_for_a_data_type(monkeypatch):
    """As oneDNN's bfloat16, which needs AVX-512."""
    monkeypatch.setattr(products, "onednn_linear", lambda dtype: th.mm if dtype == th.float32 else None)
    assert set(products.kernels(CPU, th.float32)) == {"mm", "oneDNN"}
    assert set(products.kernels(CPU, th.bfloat16)) == {"mm"}
    assert set(products.kernels(th.device("cuda"), th.float32)) == {"mm"}


def test_sizes_are_varied_one_at_a_time():
    sizes = cem_calls.sizes_to_measure(["batch", "width"])
    assert sizes[:2] == [Sizes(), LIGHT]
    assert len(set(sizes)) == len(sizes) == 2 + 4 + 4
    assert {(size.batch, size.width) for size in sizes} == {
        *((batch, 256) for batch in (1, 32, 128, 256, 512)),
        *((128, width) for width in (64, 128, 256, 512, 1024)),
    }


def test_selector_writes_what_follows_from_the_seconds(tmp_path):
    record = run_command("selector", tmp_path, "--rounds", "2", "--dtypes", "float32", "--vary")
    entry, light = record["calls"]
    paper = dict(batch=128, samples=64, iterations=2, action_dim=6, width=256, n_features=17, start="prior")
    assert entry["sizes"] == paper
    assert light["sizes"] == paper | dict(samples=16, iterations=1, start="actor")
    assert light["call_flops"] < entry["call_flops"] / 7
    call, plain = entry["call_seconds"]["all"], entry["plain_seconds"]["all"]
    assert len(call) == len(plain) == 2
    assert entry["ratio_to_plain"] == pytest.approx((call[0] / plain[0] + call[1] / plain[1]) / 2)
    assert entry["flops_per_second"] == pytest.approx(entry["call_flops"] / np.mean(call))
    medians = {way: product["median"] for way, product in entry["product_seconds"].items()}
    assert len(medians) == 4 * len(products.kernels(CPU, th.float32))
    floor = entry["fastest_product"]
    assert medians[floor] == min(medians.values())
    fastest = entry["product_seconds"][floor]["all"]
    outer = entry["outer_product_seconds"]["all"]
    assert entry["share_of_hidden_products"] == pytest.approx((fastest[0] / call[0] + fastest[1] / call[1]) / 2)
    shares = [(fastest[turn] + outer[turn]) / call[turn] for turn in range(2)]
    assert entry["share_of_products"] == pytest.approx(sum(shares) / 2)
    row = next(line for line in unpadded((tmp_path / "selector.md").read_text()).splitlines() if "128 × 64 × 2" in line)
    assert f"| {entry['ratio_to_plain']:.2f} |" in row
    assert f"| {entry['share_of_products']:.0%} |" in row


def test_the_light_call_scores_sixteen_actions_from_the_actors_and_the_papers_twice_64_of_the_prior():
    def calls(sizes):
        seen = []

        def make_score(network, features):
            score = repeated_q_score(network, features)
            return lambda actions: seen.append(actions.clone()) or score(actions)

        run = cem_calls.cem_call(sizes, make_score, CPU)
        run()
        run()
        return seen

    first, second = calls(LIGHT)
    assert first.shape == (128, 16, 6)
    # The actor's actions, which are given, are the first samples of each call
    assert th.equal(first[:, 0], second[:, 0])
    papers = calls(Sizes())
    assert [actions.shape for actions in papers] == [(128, 64, 6)] * 4
    assert not th.equal(papers[0][:, 0], papers[2][:, 0])


def test_selector_asks_for_the_data_type(tmp_path, monkeypatch):
    asked = set()

    def score(network, features, dtype):
        asked.add(dtype)
        return repeated_q_score(network, features)

    monkeypatch.setattr(cem_calls, "q_score", score)
    run_command("selector", tmp_path, "--rounds", "1", "--dtypes", "bfloat16", "--vary")
    assert asked == {th.bfloat16}


@pytest.mark.parametrize("sizes", [Sizes(), Sizes(batch=5, samples=3, iterations=4, action_dim=2, width=8, n_features=7)])
def test_outer_and_hidden_products_are_all_that_a_call_multiplies(monkeypatch, sizes):
    counted = []

    def multiply(left, right, out):
        assert (left.dtype, out.shape) == (th.float32, (left.shape[0], right.shape[1]))
        counted.append(2 * left.shape[0] * left.shape[1] * right.shape[1])

    run = products.first_and_last_layer_products(sizes, CPU)
    monkeypatch.setattr(th, "mm", multiply)
    run()
    assert sum(counted) + products.product_flops(sizes) == products.call_flops(sizes)
