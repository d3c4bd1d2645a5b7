"""
The Cross-Entropy Method (Algorithm 1 of the paper) and the interface that a selector of actions has.

Shapes: B states, N samples per state, K elites per state, A action dimensions.
"""

from collections.abc import Callable
from typing import NamedTuple, Protocol

import torch as th

from sb3_cgp.common.rules import check_cem

# Scores N actions for each of B states: (B, N, A) in [-1, 1] -> (B, N), higher is better
Score = Callable[[th.Tensor], th.Tensor]

# From which on a function that is faster makes up for its further operations
MANY_VALUES = 2**12


class Selection(NamedTuple):
    """
    What a selector found.

    :param actions: the selected actions, (B, A), within [-1, 1]
    :param elites: the best of the last samples, (B, K, A), CEM's before tanh; how much they differ is how unsure it was
    """

    actions: th.Tensor
    elites: th.Tensor

    @property
    def spread(self) -> th.Tensor:
        """Standard deviation of the distribution that is fitted to the elites, (B, A)."""
        return _fit(self.elites)[1].squeeze(1)


class ActionSelector(Protocol):
    """Selects, for each of a batch of states, an action that a scoring function rates highly."""

    def select(self, score: Score, n_states: int, action_dim: int, device: th.device | str = "cpu") -> Selection:
        """
        Select an action for each state.

        :param score: scores N actions per state: (B, N, A) within [-1, 1] -> (B, N)
        :param n_states: number of states, B
        :param action_dim: number of action dimensions, A
        :param device: the device on which ``score`` works
        :return: the selected actions
        """


class CEM:
    """
    Cross-Entropy Method with independent Gaussians (Algorithm 1), squashed by tanh into the action space.

    :param iterations: number of iterations N of Algorithm 1, at least 1
    :param samples: number of samples n per state and iteration, at least 1
    :param elites: number of winners k that the next distribution is fitted to, from 1 to ``samples``
    :param result: "best" returns the best-scoring sample of the last iteration, as the paper does;
        "mean" returns the mean of the last elites, which averages out the sampling
    :raises ValueError: if an argument is out of its range
    """

    def __init__(self, iterations: int = 2, samples: int = 64, elites: int = 6, result: str = "best"):
        check_cem(iterations, samples, elites, result)
        self.iterations = iterations
        self.samples = samples
        self.elites = elites
        self.result = result

    def __repr__(self) -> str:
        return f"CEM(iterations={self.iterations}, samples={self.samples}, elites={self.elites}, result={self.result!r})"

    @th.no_grad()
    def select(self, score: Score, n_states: int, action_dim: int, device: th.device | str = "cpu") -> Selection:
        """
        Maximise ``score`` for each state by Algorithm 1, drawing from PyTorch's global generator.

        A sample whose score is NaN is never preferred to one whose score is not.

        :param score: scores N actions per state: (B, N, A) within [-1, 1] -> (B, N)
        :param n_states: number of states, B
        :param action_dim: number of action dimensions, A
        :param device: the device on which ``score`` works
        :return: the selected actions (B, A) and the last elites (B, K, A)
        """
        # From the standard normal distribution
        samples = th.randn(n_states, self.samples, action_dim, device=device)  # (B, N, A)
        elites = self._select_elites(score, samples)
        for _ in range(self.iterations - 1):
            mean, std = _fit(elites)
            samples = th.addcmul(mean, std, th.randn(n_states, self.samples, action_dim, device=device))
            elites = self._select_elites(score, samples)
        result = elites[:, 0] if self.result == "best" else elites.mean(dim=1)
        return Selection(actions=_squash(result), elites=elites)

    def _select_elites(self, score: Score, samples: th.Tensor) -> th.Tensor:
        """Select the elites of samples before tanh, (B, N, A): (B, K, A), best first."""
        values = score(_squash(samples)).nan_to_num(nan=-th.inf, posinf=th.inf, neginf=-th.inf)  # (B, N)
        winners = values.topk(self.elites, dim=1).indices  # (B, K)
        return samples.gather(1, winners.unsqueeze(2).expand(-1, -1, samples.shape[2]))


def _squash(values: th.Tensor) -> th.Tensor:
    """Compute tanh; of many values by the logistic function, which takes PyTorch a fifth of the time on a CPU."""
    if values.numel() < MANY_VALUES:
        return values.tanh()
    return (2.0 * values).sigmoid_().mul_(2.0).sub_(1.0)


def _fit(elites: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """Fit independent Gaussians to elites, (B, K, A): their mean and standard deviation, (B, 1, A) each."""
    mean = elites.mean(dim=1, keepdim=True)
    # Much faster here than `std`
    return mean, (elites - mean).square().mean(dim=1, keepdim=True).sqrt()
