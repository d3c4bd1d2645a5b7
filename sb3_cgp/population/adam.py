"""Adam for the stacked parameters of many agents, with a learning rate and a step count of each agent."""

import math
from collections.abc import Sequence

import torch as th
from torch import nn


class AgentAdam(nn.Module):
    """
    ``torch.optim.Adam`` for parameters with an axis of agents, (C, N, ...): each agent has a learning rate and a step count
    of its own, and may pause.

    PyTorch's Adam has one learning rate for a tensor. The state consists of buffers, which a step changes in place.

    :param parameters: the parameters, (C, N, *, *) each
    :param betas: coefficients of the moving averages of the gradient and of its square
    :param eps: added to the denominator
    """

    steps: th.Tensor
    rates: th.Tensor

    def __init__(self, parameters: Sequence[th.Tensor], betas: tuple[float, float] = (0.9, 0.999), eps: float = 1e-8):
        super().__init__()
        self._betas, self._eps = betas, eps
        shape = (parameters[0].shape[1], 1, 1)
        self.register_buffer("steps", th.zeros(shape))
        self.register_buffer("rates", th.zeros(shape))
        for index, parameter in enumerate(parameters):
            self.register_buffer(f"exp_avg_{index}", th.zeros_like(parameter))
            self.register_buffer(f"exp_avg_sq_{index}", th.zeros_like(parameter))

    @classmethod
    def like(cls, optimizer: th.optim.Optimizer, parameters: Sequence[th.Tensor]) -> "AgentAdam":
        """
        Make the optimizer of stacked parameters from the one of an agent alone.

        :param optimizer: the agent's Adam
        :param parameters: the stacked parameters
        :return: an Adam of the same coefficients
        """
        return cls(parameters, optimizer.defaults["betas"], optimizer.defaults["eps"])

    def moments(self, name: str) -> list[th.Tensor]:
        """
        Return one of the two moving averages for all parameters.

        :param name: "exp_avg" or "exp_avg_sq", as in the state of PyTorch's Adam
        :return: the averages, (C, N, *, *) each
        """
        buffers = dict(self.named_buffers())
        n_parameters = (len(buffers) - 2) // 2
        return [buffers[f"{name}_{index}"] for index in range(n_parameters)]

    @th.no_grad()
    def step(self, parameters: Sequence[th.Tensor], gradients: Sequence[th.Tensor], due: th.Tensor) -> None:
        """
        Take a step with the agents that are due. Nothing of the others changes, whatever their gradients are.

        :param parameters: the parameters
        :param gradients: their gradients
        :param due: whether each agent takes a step, a bool tensor, (N, 1, 1)
        """
        beta1, beta2 = self._betas
        self.steps.add_(due)
        # Of an agent that has never been due, the corrections would be 0
        steps = self.steps.clamp(min=1)
        # 1 - beta ** steps, without its rounding error
        step_size = th.where(due, self.rates / -th.expm1(steps * math.log(beta1)), 0.0)
        root_correction = (-th.expm1(steps * math.log(beta2))).sqrt()
        weight, decay = (1 - beta1) * due.to(steps), 1 - (1 - beta2) * due.to(steps)
        averages = zip(self.moments("exp_avg"), self.moments("exp_avg_sq"), strict=True)
        for parameter, gradient, (exp_avg, exp_avg_sq) in zip(parameters, gradients, averages, strict=True):
            gradient = th.where(due, gradient, 0.0)
            exp_avg.lerp_(gradient, weight)
            exp_avg_sq.mul_(decay).addcmul_(gradient, gradient, value=1 - beta2)
            denominator = (exp_avg_sq.sqrt() / root_correction).add_(self._eps)
            parameter.sub_(step_size * exp_avg / denominator)
