"""Matrix products of linear layers, by the fastest function that PyTorch has for them."""

import functools
from collections.abc import Callable, Iterable
from typing import TypeGuard

import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_cgp.common.networks import is_hooked

# Number of multiplications from which on oneDNN is faster despite the cost of its call
MANY_MULTIPLICATIONS = 2**24


def onednn_linear(dtype: th.dtype) -> Callable[..., th.Tensor] | None:
    """
    Return oneDNN's linear layer, a private operator of PyTorch that its compiler uses.

    PyTorch's public linear layer calls MKL for float32, which takes longer on AMD's processors: on one thread of a Zen 4 by
    7 %, on two by 15 %.

    :param dtype: the data type
    :return: the operator; None if PyTorch has none for this processor, or if ``torch.backends.mkldnn`` is disabled
    """
    return _probe_onednn_linear(dtype) if th.backends.mkldnn.enabled else None


@functools.cache
def _probe_onednn_linear(dtype: th.dtype) -> Callable[..., th.Tensor] | None:
    linear = getattr(th.ops.mkldnn, "_linear_pointwise", None) if th.backends.mkldnn.is_available() else None
    if linear is not None:
        try:
            linear(th.ones(1, 1, dtype=dtype), th.ones(1, 1, dtype=dtype), None, "none", [], "")
        except RuntimeError:
            return None
    return linear


def multiply(inputs: th.Tensor, weight: th.Tensor, bias: th.Tensor | None = None) -> th.Tensor:
    """
    Compute a linear layer, without gradients.

    :param inputs: the rows, (rows, inputs)
    :param weight: the layer's weight, (outputs, inputs)
    :param bias: the layer's bias, (outputs,)
    :return: the outputs, (rows, outputs), in newly allocated memory
    """
    is_large = inputs.device.type == "cpu" and inputs.shape[0] * weight.numel() >= MANY_MULTIPLICATIONS
    linear = onednn_linear(inputs.dtype) if is_large else None
    if linear is None:
        return F.linear(inputs, weight, bias)
    # The operator could apply ReLU too, but that would turn NaN into zero
    return linear(inputs, weight, bias, "none", [], "")


def is_linear(module: nn.Module) -> TypeGuard[nn.Linear]:
    """
    Return whether a module is PyTorch's linear layer, not a subclass, which could compute anything.

    :param module: the module
    :return: whether it is
    """
    return type(module) is nn.Linear


def leading_relu_layers(modules: Iterable[nn.Module]) -> list[nn.Linear]:
    """
    List the linear layers at the beginning of a sequence that have only ReLU between them, and no hooks.

    :param modules: the modules of the sequence
    :return: the layers
    """
    layers: list[nn.Linear] = []
    for index, module in enumerate(modules):
        if is_hooked(module) or not (is_linear(module) if index % 2 == 0 else type(module) is nn.ReLU):
            break
        if is_linear(module):
            layers.append(module)
    return layers
