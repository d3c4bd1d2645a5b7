"""Multilayer perceptrons that are trained in fewer and faster operations on a CPU."""

from typing import Any

import torch as th
from torch import nn
from torch.autograd.function import once_differentiable

from sb3_cgp.fast.linear import multiply, rectified_layers

# Rows from which on there is something to gain
MANY_ROWS = 32


class Perceptron(nn.Sequential):
    """
    A sequence of modules that computes itself what linear layers with rectifiers between them do at its beginning.

    It does so for batches of float32 on a CPU, where it can; elsewhere it is PyTorch's sequence. Such a batch has no second
    derivatives, nor does ``torch.func`` know its gradient.
    """

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        """
        Pass a batch through all modules.

        :param inputs: the batch, (rows, inputs)
        :return: the outputs, (rows, outputs)
        """
        layers = rectified_layers(self) if _is_for_us(inputs) else []
        if not layers:
            return super().forward(inputs)
        parameters = [parameter for layer in layers for parameter in (layer.weight, layer.bias)]
        outputs = _Layers.apply(inputs, *parameters)
        for module in list(self)[2 * len(layers) - 1 :]:
            outputs = module(outputs)
        return outputs


def _is_for_us(inputs: th.Tensor) -> bool:
    # What is traced is to be computed elsewhere
    if th.jit.is_tracing() or th.compiler.is_compiling() or th.is_autocast_enabled("cpu"):
        return False
    is_batch = inputs.dim() == 2 and inputs.shape[0] >= MANY_ROWS
    return is_batch and inputs.device.type == "cpu" and inputs.dtype == th.float32


class _Layers(th.autograd.Function):
    """Linear layers with rectifiers between them; autograd's own gradient asks MKL, which is slow on AMD's processors."""

    @staticmethod
    def forward(ctx: Any, inputs: th.Tensor, *parameters: th.Tensor) -> th.Tensor:
        """
        Pass a batch through the layers.

        :param ctx: keeps what the gradient needs
        :param inputs: the batch, (rows, inputs)
        :param parameters: the first layer's weight, its bias, the second layer's weight, ...
        :return: the outputs, (rows, outputs)
        """
        weights, biases = parameters[::2], parameters[1::2]
        hidden = [inputs]
        for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
            hidden.append(multiply(hidden[-1], weight, bias).relu_())
        ctx.save_for_backward(*hidden, *weights)
        return multiply(hidden[-1], weights[-1], biases[-1])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: th.Tensor) -> tuple[th.Tensor | None, ...]:
        """
        Pass a gradient back.

        :param ctx: what ``forward`` kept
        :param gradient: the gradient by the outputs, (rows, outputs)
        :return: the gradients by the inputs and by the parameters; None where none is needed
        """
        n_layers = len(ctx.saved_tensors) // 2
        hidden, weights = ctx.saved_tensors[:n_layers], ctx.saved_tensors[n_layers:]
        gradients: list[th.Tensor | None] = [None] * (1 + 2 * n_layers)
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
