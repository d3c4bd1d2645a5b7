"""
The arithmetic of one CEM call, and its matrix products alone, whose time is the lower bound of the call's.

Shapes: B states, N samples per state, A action dimensions, F features, H units of each of two hidden layers.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch as th

from sb3_cgp.fast.linear import onednn_linear

# Rows of the blocks that are tried, besides all rows at once: on a CPU, a block that stays in cache is often faster
BLOCK_ROWS = (256, 1024, 2048)
# Multiplies (rows, H) by a linear layer's weights, (H, H), and may write to a given tensor
Kernel = Callable[[th.Tensor, th.Tensor, th.Tensor], object]


@dataclass(frozen=True)
class Sizes:
    """
    The sizes of one CEM call, by default the paper's on HalfCheetah.

    :param batch: states, B
    :param samples: samples per state and iteration, N
    :param iterations: iterations of CEM
    :param action_dim: action dimensions, A
    :param width: units of each of the two hidden layers, H
    :param n_features: features of a state, F
    :param start: where CEM starts: "prior", or "actor", whose actions are given
    """

    batch: int = 128
    samples: int = 64
    iterations: int = 2
    action_dim: int = 6
    width: int = 256
    n_features: int = 17
    start: str = "prior"

    @property
    def actions(self) -> int:
        """Actions scored in one iteration."""
        return self.batch * self.samples


# The call of CGP-Light
LIGHT = Sizes(samples=16, iterations=1, start="actor")


def call_flops(sizes: Sizes) -> int:
    """
    Return the number of a CEM call's useful floating-point operations: a multiplication and an addition for each weight in the
    critic's matrix products, with the states' part of the first layer computed once. Sampling, activations and sorting are not
    counted.

    :param sizes: the call's sizes
    :return: the operations
    """
    per_state = sizes.n_features * sizes.width
    per_action = sizes.action_dim * sizes.width + sizes.width**2 + sizes.width
    return 2 * (sizes.batch * per_state + sizes.iterations * sizes.actions * per_action)


def product_flops(sizes: Sizes) -> int:
    """
    Return the number of operations of the bare products: (B N, H) times (H, H) once per iteration, between the hidden layers.

    :param sizes: the call's sizes
    :return: the operations
    """
    return 2 * sizes.iterations * sizes.actions * sizes.width**2


def first_and_last_layer_products(sizes: Sizes, device: th.device) -> Callable[[], object]:
    """
    Return the call's other products, all in float32: once the states' part of the first layer; per iteration the actions'
    part, (B N, A) times (A, H), and the last layer, (B N, H) times (H, 1). Operands and results are allocated here, once.

    :param sizes: the call's sizes
    :param device: the device
    :return: the function to time
    """

    def operands(rows: int, inner: int, columns: int) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        left, right = th.randn(rows, inner, device=device), th.randn(inner, columns, device=device)
        return left, right, th.empty(rows, columns, device=device)

    states = operands(sizes.batch, sizes.n_features, sizes.width)
    each_iteration = [operands(sizes.actions, sizes.action_dim, sizes.width), operands(sizes.actions, sizes.width, 1)]

    @th.no_grad()
    def run() -> None:
        for left, right, result in [states, *each_iteration * sizes.iterations]:
            th.mm(left, right, out=result)

    return run


def kernels(device: th.device, dtype: th.dtype) -> dict[str, Kernel]:
    """
    Return the ways of multiplying to try: the fastest differs between processors.

    :param device: the device
    :param dtype: the data type, which oneDNN may not support on this processor
    :return: the ways, by name
    """
    found: dict[str, Kernel] = {"mm": lambda left, weight, result: th.mm(left, weight.t(), out=result)}
    linear = onednn_linear(dtype) if device.type == "cpu" else None
    if linear is not None:
        found["oneDNN"] = lambda left, weight, result: linear(left, weight, None, "none", [], "")
    return found


def bare_products(sizes: Sizes, dtype: th.dtype, device: th.device) -> dict[str, Callable[[], object]]:
    """
    Return the bare products of a CEM call, in one piece and in blocks that are reused, so that they stay in cache.

    Operands are allocated here, once, and so are results where the kernel allows it.

    :param sizes: the call's sizes
    :param dtype: the data type
    :param device: the device
    :return: the functions to time, by name; the fastest is the lower bound
    """
    blocks = {"whole": sizes.actions}
    blocks.update({f"blocks of {rows} rows": rows for rows in BLOCK_ROWS if rows < sizes.actions})
    return {
        f"{kernel}, {block}": _product(sizes, rows, dtype, device, multiply)
        for kernel, multiply in kernels(device, dtype).items()
        for block, rows in blocks.items()
    }


def _product(sizes: Sizes, rows: int, dtype: th.dtype, device: th.device, multiply: Kernel) -> Callable[[], object]:
    weight = th.randn(sizes.width, sizes.width, device=device).to(dtype)
    block = th.randn(rows, sizes.width, device=device).to(dtype)
    result = th.empty_like(block)
    whole_blocks, rest = divmod(sizes.actions, rows)

    @th.no_grad()
    def run() -> None:
        for _ in range(sizes.iterations):
            for _ in range(whole_blocks):
                multiply(block, weight, result)
            if rest > 0:
                multiply(block[:rest], weight, result[:rest])

    return run
