"""Multilayer perceptrons whose training is faster on AMD's processors."""

from collections.abc import Sequence
from typing import Any

import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_cgp.fast.linear import leading_relu_layers, multiply, onednn_linear

# Number of rows from which on the own operations are faster than PyTorch's
MANY_ROWS = 32


class MLP(nn.Sequential):
    """
    A sequence of modules whose leading linear layers, with ReLU between them, are one autograd function.

    The function is used for float32 batches on a CPU where oneDNN is faster than PyTorch's linear layers. Everywhere else
    the modules are called one by one, as PyTorch does. ``torch.func`` does not support the function.
    """

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        """
        Compute the outputs of a batch.

        :param inputs: the batch, (rows, inputs)
        :return: the outputs, (rows, outputs)
        """
        layers = leading_relu_layers(self) if _is_supported(inputs) else []
        if not layers:
            return super().forward(inputs)
        parameters = [parameter for layer in layers for parameter in (layer.weight, layer.bias)]
        outputs = _ReLULayers.apply(inputs, *parameters)
        for module in list(self)[2 * len(layers) - 1 :]:
            outputs = module(outputs)
        return outputs


def _is_supported(inputs: th.Tensor) -> bool:
    # A traced or compiled network shall consist of PyTorch's operators
    if th.jit.is_tracing() or th.compiler.is_compiling() or th.is_autocast_enabled("cpu"):
        return False
    is_batch = inputs.dim() == 2 and inputs.shape[0] >= MANY_ROWS and inputs.dtype == th.float32
    return is_batch and inputs.device.type == "cpu" and onednn_linear(th.float32) is not None


class _ReLULayers(th.autograd.Function):
    """Linear layers with ReLU between them. PyTorch's own gradient calls MKL, which is slow on AMD's processors."""

    @staticmethod
    def forward(ctx: Any, inputs: th.Tensor, *parameters: th.Tensor) -> th.Tensor:
        """
        Compute the outputs of a batch.

        :param ctx: autograd's context, which keeps the activations for the gradient
        :param inputs: the batch, (rows, inputs)
        :param parameters: the first layer's weight, its bias, the second layer's weight, ...
        :return: the outputs, (rows, outputs)
        """
        weights, biases = parameters[::2], parameters[1::2]
        hidden = []
        outputs = inputs
        for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
            outputs = multiply(outputs, weight, bias).relu_()
            hidden.append(outputs)
        ctx.save_for_backward(inputs, *parameters, *hidden)
        return multiply(outputs, weights[-1], biases[-1])

    @staticmethod
    def backward(ctx: Any, gradient: th.Tensor) -> tuple[th.Tensor | None, ...]:
        """
        Compute the gradients by the inputs and the parameters.

        :param ctx: autograd's context, with the activations of ``forward``
        :param gradient: the gradient by the outputs, (rows, outputs)
        :return: the gradients by the inputs and by the parameters; None where none is needed
        """
        n_layers = (len(ctx.needs_input_grad) - 1) // 2
        inputs, *others = ctx.saved_tensors
        parameters, hidden = others[: 2 * n_layers], [inputs, *others[2 * n_layers :]]
        # With `create_graph=True`
        if th.is_grad_enabled():
            return _differentiable_gradients(inputs, parameters, gradient, ctx.needs_input_grad)
        weights = parameters[::2]
        gradients: list[th.Tensor | None] = [None] * len(ctx.needs_input_grad)
        for layer in reversed(range(n_layers)):
            if ctx.needs_input_grad[1 + 2 * layer]:
                gradients[1 + 2 * layer] = multiply(gradient.t(), hidden[layer].t())
            if ctx.needs_input_grad[2 + 2 * layer]:
                gradients[2 + 2 * layer] = gradient.sum(dim=0)
            if layer > 0:
                gradient = th.ops.aten.threshold_backward(multiply(gradient, weights[layer].t()), hidden[layer], 0)
            elif ctx.needs_input_grad[0]:
                gradients[0] = multiply(gradient, weights[0].t())
        return tuple(gradients)


def _differentiable_gradients(
    inputs: th.Tensor, parameters: Sequence[th.Tensor], gradient: th.Tensor, needed: Sequence[bool]
) -> tuple[th.Tensor | None, ...]:
    """Compute the gradients by PyTorch's own functions, which have second derivatives."""
    # Views, so that a derivative does not follow the history of the inputs, which may depend on the same parameters
    inputs, *parameters = (tensor if tensor is None else tensor.view_as(tensor) for tensor in (inputs, *parameters))
    outputs = inputs
    for index in range(0, len(parameters), 2):
        outputs = F.linear(outputs.relu() if index > 0 else outputs, parameters[index], parameters[index + 1])
    wanted = [tensor for tensor, is_needed in zip((inputs, *parameters), needed, strict=True) if is_needed]
    gradients = iter(th.autograd.grad(outputs, wanted, gradient, create_graph=True))
    return tuple(next(gradients) if is_needed else None for is_needed in needed)
