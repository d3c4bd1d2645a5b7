"""
The Cross-Entropy Method (Algorithm 1 of the paper), and the interface of an action selector.

Shapes: B states, N samples per state, K elites per state, A action dimensions.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch as th

from sb3_cgp.core.arguments import check_cem

# Scores N actions for each of B states: (B, N, A) in [-1, 1] -> (B, N), higher is better
Score = Callable[[th.Tensor], th.Tensor]


class Selection(NamedTuple):
    """
    The result of an action selector.

    :param actions: the selected actions, (B, A), within [-1, 1]
    :param elites: the best of the last samples before tanh, (B, K, A)
    """

    actions: th.Tensor
    elites: th.Tensor

    @property
    def std(self) -> th.Tensor:
        """Standard deviation of the Gaussian fitted to the elites, (B, A): how uncertain the selector was."""
        return fit_gaussian(self.elites)[1].squeeze(1)


class ActionSelector(Protocol):
    """Selects an action that a scoring function rates highly, for each state of a batch."""

    def select(self, score: Score, n_states: int, action_dim: int, device: th.device | str = "cpu") -> Selection:
        """
        Select an action for each state.

        :param score: scores N actions per state: (B, N, A) within [-1, 1] -> (B, N)
        :param n_states: number of states, B
        :param action_dim: number of action dimensions, A
        :param device: the device of ``score``
        :return: the selected actions and the elites
        """


@dataclass
class CEM:
    """
    Cross-Entropy Method with independent Gaussians (Algorithm 1), squashed by tanh into the action space.

    :param iterations: number of iterations of Algorithm 1, at least 1
    :param samples: number of samples per state and iteration, at least 1
    :param elites: number of best samples to which the next Gaussian is fitted, from 1 to ``samples``
    :param result: "best" returns the best of the last samples (the paper), "mean" the last elites' mean, which varies less
    :raises ValueError: if an argument is out of its range
    """

    iterations: int = 2
    samples: int = 64
    elites: int = 6
    result: str = "best"

    def __post_init__(self) -> None:
        check_cem(self.iterations, self.samples, self.elites, self.result)

    @th.no_grad()
    def select(self, score: Score, n_states: int, action_dim: int, device: th.device | str = "cpu") -> Selection:
        """
        Maximise ``score`` for each state by Algorithm 1, with random numbers of PyTorch's global generator.

        The parameters are those of :class:`ActionSelector`. A NaN score ranks last, where `topk` would rank it first.

        :return: the selected actions (B, A) and the last elites (B, K, A)
        """
        shape = (n_states, self.samples, action_dim)
        # The first Gaussian has mean 0 and standard deviation 1 (the text of Section 3.1 says mean 1, Algorithm 1 says 0)
        samples = th.randn(shape, device=device)
        elites = take(samples, find_elites(score(samples.tanh()), self.elites))
        for _ in range(self.iterations - 1):
            mean, std = fit_gaussian(elites)
            samples = th.addcmul(mean, std, th.randn(shape, device=device))
            elites = take(samples, find_elites(score(samples.tanh()), self.elites))
        result = elites[:, 0] if self.result == "best" else elites.mean(dim=1)
        return Selection(actions=result.tanh(), elites=elites)


def find_elites(values: th.Tensor, n_elites: int) -> th.Tensor:
    """Return the indices of the highest values (B, N), best first, as (B, K, 1). A NaN ranks last, even below -inf."""
    return values.nan_to_num(nan=-th.inf).topk(n_elites, dim=1).indices.unsqueeze(2)  # -inf becomes the lowest float


def take(values: th.Tensor, indices: th.Tensor) -> th.Tensor:
    """Take each state's samples (B, N, A), or values of theirs, by the indices (B, K, 1), as (B, K, A)."""
    # Two to three times as fast as `torch.take_along_dim`
    return values.gather(1, indices.expand(-1, -1, values.shape[2]))


def fit_gaussian(elites: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """
    Fit independent Gaussians to elites, with the population variance (divided by K).

    :param elites: samples before tanh, (B, K, A)
    :return: mean and standard deviation, (B, 1, A) each
    """
    mean = elites.mean(dim=1, keepdim=True)
    # Several times faster than `Tensor.std` on these shapes
    return mean, (elites - mean).square().mean(dim=1, keepdim=True).sqrt()
