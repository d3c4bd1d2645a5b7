"""The operators that a function of tensors dispatches, the operations of its products, and the memory that it moves."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import torch as th
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import flop_registry

# They make no operator of the device: memory alone, and numbers of the host
IDLE = ("empty", "scalar_tensor", "lift_fresh")


@dataclass(frozen=True)
class Operation:
    """
    An operator that was dispatched, and launches at least one kernel on a GPU.

    :param name: its name
    :param flops: floating-point operations of a matrix product, a multiplication and an addition for each weight; 0 for others
    :param n_bytes: bytes of the tensors that it reads and writes
    :param shapes: the shapes of a product's factors; none for others
    """

    name: str
    flops: int
    n_bytes: int
    shapes: tuple[tuple[int, ...], ...] = ()


class _Recorder(TorchDispatchMode):
    """List the operators that are dispatched while it is active, in forward and backward passes."""

    def __init__(self) -> None:
        super().__init__()
        self.operations: list[Operation] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        results = func(*args, **kwargs)
        if not _is_view(func) and not func.__name__.startswith(IDLE):
            self.operations.append(_describe(func, args, kwargs, results))
        return results


def _is_view(func: Any) -> bool:
    """Return whether an operator's result is another view of an argument's memory."""
    return any(each.alias_info is not None and not each.alias_info.is_write for each in func._schema.returns)


def _describe(func: Any, args: Any, kwargs: Any, results: Any) -> Operation:
    count = flop_registry.get(func.overloadpacket)
    flops = 0 if count is None else int(count(*args, **kwargs, out_val=results))
    read = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, th.Tensor)]
    written = [leaf for leaf in tree_leaves(results) if isinstance(leaf, th.Tensor)]
    factors = [tensor for tensor in read if flops > 0][-2:]
    n_bytes = sum(_stored(tensor) * tensor.element_size() for tensor in (*read, *written))
    return Operation(func.overloadpacket.__name__, flops, n_bytes, tuple(tuple(each.shape) for each in factors))


def _stored(tensor: th.Tensor) -> int:
    """Return the number of a tensor's elements in memory: an expanded axis is there once."""
    return math.prod(size for size, stride in zip(tensor.shape, tensor.stride(), strict=True) if stride != 0)


def record_operations(run: Callable[[], object]) -> list[Operation]:
    """
    Call a function once, and list its operators, except views.

    :param run: the function; with tensors on the "meta" device, nothing is computed
    :return: the operators, in order
    """
    with _Recorder() as recorder:
        run()
    return recorder.operations


def total_flops(operations: Iterable[Operation]) -> int:
    """
    Return the operations of all products.

    :param operations: the operators
    :return: floating-point operations
    """
    return sum(operation.flops for operation in operations)


def bare_products(operations: Sequence[Operation], device: th.device) -> Callable[[], object]:
    """
    Return a function that computes the same products alone. Factors and results of each shape are allocated here, once.

    :param operations: the operators
    :param device: the device
    :return: the function to time
    """
    tensors: dict[Any, tuple[th.Tensor, ...]] = {}
    products = []
    for operation in operations:
        if operation.flops > 0:
            if operation.shapes not in tensors:
                left, right = (th.randn(*shape, device=device) for shape in operation.shapes)
                tensors[operation.shapes] = left, right, th.matmul(left, right)
            products.append(tensors[operation.shapes])

    @th.no_grad()
    def run() -> None:
        for left, right, result in products:
            th.matmul(left, right, out=result)

    return run
