"""
Slow and obvious twins of the package's fast paths.

Nothing here imports the package, so that it cannot share a mistake with it.
"""

import math
from collections.abc import Callable, Sequence

import torch as th


def cem(
    score: Callable[[list[float]], float], draws: Sequence[Sequence[Sequence[float]]], elites: int
) -> tuple[list[float], list[float], list[float]]:
    """
    Algorithm 1 for one state, a loop for every line of it.

    :param score: the value of one action
    :param draws: standard normal draws: draws[iteration][sample][dimension]
    :param elites: number of winners k
    :return: the best action of the last iteration, the last mean and the last standard deviation (before tanh)
    """
    n_dimensions = len(draws[0][0])
    mean = [0.0] * n_dimensions
    variance = [1.0] * n_dimensions
    best_action = [0.0] * n_dimensions
    for iteration in draws:
        samples = []
        for draw in iteration:
            samples.append([mean[i] + math.sqrt(variance[i]) * draw[i] for i in range(n_dimensions)])
        actions = [[math.tanh(value) for value in sample] for sample in samples]
        values = [score(action) for action in actions]
        order = sorted(range(len(samples)), key=lambda index: values[index], reverse=True)
        winners = order[:elites]
        for i in range(n_dimensions):
            mean[i] = sum(samples[index][i] for index in winners) / elites
            variance[i] = sum((samples[index][i] - mean[i]) ** 2 for index in winners) / elites
        best_action = actions[order[0]]
    return best_action, mean, [math.sqrt(value) for value in variance]


def mlp(weights: Sequence[th.Tensor], biases: Sequence[th.Tensor], inputs: th.Tensor) -> th.Tensor:
    """
    A multilayer perceptron with ReLU in float64, one matrix product at a time.

    :param weights: each layer's weights
    :param biases: each layer's biases
    :param inputs: one row of inputs
    :return: one row of outputs
    """
    hidden = inputs.double()
    for index, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        hidden = weight.double() @ hidden + bias.double()
        if index < len(weights) - 1:
            hidden = hidden.clamp(min=0.0)
    return hidden


def bootstrap_target(reward: float, terminated: bool, discount: float, next_values: Sequence[float]) -> float:
    """
    The critics' target of one transition.

    :param reward: its reward
    :param terminated: whether it ended the episode for good
    :param discount: the discount factor
    :param next_values: each target critic's value of the next state and action
    :return: the target
    """
    return reward if terminated else reward + discount * min(next_values)


def polyak(old: th.Tensor, new: th.Tensor, tau: float) -> th.Tensor:
    """
    A Polyak average.

    :param old: the average so far
    :param new: the value that it moves to
    :param tau: by which share
    :return: the new average
    """
    return (1.0 - tau) * old + tau * new
