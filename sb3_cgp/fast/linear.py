"""Products with the weights of linear layers, by the fastest function that PyTorch has for them."""

import functools
from collections.abc import Callable, Iterable
from typing import TypeGuard

import torch as th
from torch import nn
from torch.nn import functional as F

# Multiplications from which on oneDNN makes up for what a call of it costs
MANY_MULTIPLICATIONS = 2**21

# Rows are few if there are this many times as many outputs
FEW_ROWS = 4


@functools.cache
def onednn_linear(dtype: th.dtype) -> Callable[..., th.Tensor] | None:
    """
    Find oneDNN's linear layer, which PyTorch's compiler uses and keeps private.

    The public one asks MKL for float32, which is at half oneDNN's speed on AMD's processors.

    :param dtype: the data type
    :return: the function; None where there is none, or none for this processor
    """
    linear = getattr(th.ops.mkldnn, "_linear_pointwise", None) if th.backends.mkldnn.is_available() else None
    if linear is not None:
        try:
            linear(th.ones(1, 1, dtype=dtype), th.ones(1, 1, dtype=dtype), None, "none", [], "")
        except RuntimeError:
            return None
    return linear


def multiply(inputs: th.Tensor, weight: th.Tensor, bias: th.Tensor | None = None) -> th.Tensor:
    """
    Do what a linear layer does, without gradients.

    :param inputs: the rows to multiply, (rows, inputs)
    :param weight: the layer's weight, (outputs, inputs)
    :param bias: the layer's bias, (outputs,)
    :return: the outputs, (rows, outputs), in memory of their own
    """
    is_large = inputs.device.type == "cpu" and inputs.shape[0] * weight.numel() >= MANY_MULTIPLICATIONS
    linear = onednn_linear(inputs.dtype) if is_large else None
    if linear is None:
        return F.linear(inputs, weight, bias)
    # It could rectify, too, but makes NaN zero then
    if inputs.shape[0] * FEW_ROWS > weight.shape[0]:
        return linear(inputs, weight, bias, "none", [], "")
    # It brings its second operand into an order of its own, at the price of a copy: that is to be the smaller one
    product = linear(weight, inputs, None, "none", [], "").t()
    return product if bias is None else product.add_(bias)


def is_linear(module: nn.Module) -> TypeGuard[nn.Linear]:
    """
    Tell whether a module is a linear layer that does nothing else.

    :param module: the module
    :return: whether it is
    """
    # A subclass may do anything
    return type(module) is nn.Linear


def is_hooked(module: nn.Module) -> bool:
    """
    Tell whether calling a module does more than its ``forward``.

    :param module: the module
    :return: whether it does
    """
    # PyTorch has no public way to ask
    return bool(module._forward_hooks or module._forward_pre_hooks or module._backward_hooks or module._backward_pre_hooks)


def rectified_layers(modules: Iterable[nn.Module]) -> list[nn.Linear]:
    """
    List the linear layers at the beginning that follow one another with nothing but rectifiers between them, none hooked.

    :param modules: the modules of a sequence
    :return: the layers
    """
    layers: list[nn.Linear] = []
    for index, module in enumerate(modules):
        if is_hooked(module) or not (is_linear(module) if index % 2 == 0 else type(module) is nn.ReLU):
            break
        if is_linear(module):
            layers.append(module)
    return layers
