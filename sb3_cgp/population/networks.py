"""
Networks of many agents, whose parameters have a leading axis of agents.

Shapes: N agents, C networks per agent (critics), B rows per agent, I inputs and O outputs of a layer.
"""

import copy
from collections.abc import Iterable, Sequence
from typing import Any

import torch as th
from torch import nn

from sb3_cgp.common.rules import require
from sb3_cgp.fast.linear import is_linear


class StackedMLP(nn.Module):
    """
    The MLPs of N agents, C of each agent, as one network.

    A linear layer has a weight, (C, N, O, I), and a bias, (C, N, 1, O), and is one product for all of them.

    :param networks: each agent's networks, of the same sizes, made of linear layers and activation functions
    :raises ValueError: if a network has other modules
    """

    def __init__(self, networks: Sequence[Sequence[Any]]):
        super().__init__()
        template = networks[0][0]
        self.sizes = (len(networks[0]), len(networks))
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        # An activation function where there is no linear layer
        self.activations = nn.ModuleList()
        for index, module in enumerate(template):
            check_module(module)
            self.activations.append(nn.Identity() if is_linear(module) else copy.deepcopy(module))
            if is_linear(module):
                # The type checker does not know that all agents' modules are alike
                layers: Any = [[agent[number][index] for agent in networks] for number in range(self.sizes[0])]
                self.weights.append(_stack([[layer.weight for layer in row] for row in layers]))
                self.biases.append(_stack([[layer.bias.unsqueeze(0) for layer in row] for row in layers]))
        self.is_layer = [is_linear(module) for module in template]

    def forward(self, inputs: th.Tensor, n_networks: int | None = None) -> th.Tensor:
        """
        Compute the outputs of a batch of each agent.

        :param inputs: the rows, (N, B, I), for all of an agent's networks
        :param n_networks: number of networks of each agent that are computed, the first ones; None for all
        :return: the outputs, (C, N, B, O)
        """
        n_networks = self.sizes[0] if n_networks is None else n_networks
        hidden = inputs.expand(n_networks, *inputs.shape).flatten(0, 1)
        return self._layers(hidden, n_networks, start=0).unflatten(0, (n_networks, self.sizes[1]))

    def _layers(self, hidden: th.Tensor, n_networks: int, start: int) -> th.Tensor:
        """Pass activations, (C N, B, I), through the modules from one on."""
        n_layers = sum(self.is_layer[:start])
        for is_layer, activation in zip(self.is_layer[start:], self.activations[start:], strict=True):
            if is_layer:
                weight, bias = self.weights[n_layers][:n_networks], self.biases[n_layers][:n_networks]
                hidden = th.baddbmm(bias.flatten(0, 1), hidden, weight.flatten(0, 1).mT)
                n_layers += 1
            elif type(activation) is nn.ReLU and not hidden.requires_grad:
                hidden = hidden.relu_()
            else:
                hidden = activation(hidden)
        return hidden

    def ordered(self) -> list[nn.Parameter]:
        """Return the parameters in the order of an ordinary network's: weight and bias of each layer."""
        return [parameter for pair in zip(self.weights, self.biases, strict=True) for parameter in pair]


class StackedScore:
    """
    Scores actions, (N B, S, A), by the first network of each agent: values, (N B, S).

    The states' part of the first layer is computed once per state, as in ``fast/scoring.py``.

    :param critics: critics that begin with a linear layer
    :param features: the states' features, (N, B, F)
    """

    def __init__(self, critics: StackedMLP, features: th.Tensor):
        self._critics = critics
        weight, bias = critics.weights[0][0], critics.biases[0][0]
        n_features = features.shape[2]
        self._state_part = th.baddbmm(bias, features, weight[:, :, :n_features].mT).unsqueeze(2)  # (N, B, 1, O)
        self._action_weight = weight[:, :, n_features:].mT.contiguous()  # (N, A, O)

    def __call__(self, actions: th.Tensor) -> th.Tensor:
        """
        Score actions, without gradients.

        :param actions: actions within [-1, 1], (N B, S, A), the states of the first agent first
        :return: the values, (N B, S)
        """
        n_agents, n_states = self._state_part.shape[:2]
        by_agent = actions.view(n_agents, n_states * actions.shape[1], actions.shape[2])
        hidden = th.bmm(by_agent, self._action_weight)
        hidden.unflatten(1, (n_states, -1)).add_(self._state_part)
        return self._critics._layers(hidden, n_networks=1, start=1).view(actions.shape[:2])


def agent_slices(tensors: Iterable[th.Tensor], agent: int) -> list[th.Tensor]:
    """
    Return the parts of stacked tensors that belong to one agent, in the order of its ordinary networks' parameters.

    :param tensors: stacked tensors, (C, N, ...), in the order of :meth:`StackedMLP.ordered`
    :param agent: the agent's index
    :return: views, those of its first network first
    """
    tensors = list(tensors)
    return [tensor[number, agent] for number in range(tensors[0].shape[0]) for tensor in tensors]


def check_module(module: nn.Module) -> None:
    """
    Check that a module of an agent's network can be stacked.

    :param module: the module
    :raises ValueError: if it is neither a linear layer nor an activation function without parameters
    """
    has_state = any(True for _ in (*module.parameters(), *module.buffers()))
    is_activation = type(module).__module__ == "torch.nn.modules.activation" and not has_state
    allowed = "such that networks have linear layers and PyTorch's activation functions without parameters alone"
    require(is_linear(module) or is_activation, "policy_kwargs", type(module).__name__, f"{allowed} in a population")


def _stack(rows: list[list[th.Tensor]]) -> nn.Parameter:
    """Stack C rows of N tensors to a parameter, (C, N, ...)."""
    return nn.Parameter(th.stack([th.stack([each.detach() for each in row]) for row in rows]))
