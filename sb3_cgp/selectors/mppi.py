"""
Model Predictive Path Integral control (MPPI) with a horizon of one step: elites are weighted by the softmax of their values.

Shapes: B states, P proposals, N samples and K elites per state, A action dimensions.
"""

from dataclasses import dataclass

import torch as th

from sb3_cgp.common.rules import require, require_number
from sb3_cgp.core.arguments import check_cem
from sb3_cgp.core.cem import Score, Selection, find_elites, take
from sb3_cgp.selectors.proposals import ActorStart


@dataclass
class MPPI:
    """
    Fits each next Gaussian to the elites weighted by the softmax of their values, as TD-MPC2 does.

    Values are divided by their standard deviation over the state's samples, so that the temperature does not depend on
    the scale of rewards. With a high temperature all elites count alike, as in CEM; with a low one only the best. As it uses
    more than the order of the values, give ``CGP`` ``cem_dtype="float32"``: bfloat16 rounds them.

    :param iterations: number of iterations, at least 1
    :param samples: number of samples per state and iteration, at least 1
    :param elites: number of best samples that count, from 1 to ``samples``
    :param result: "best" returns the best sample of the last iteration, "mean" the weighted mean of the last elites
    :param temperature: temperature of the softmax, above 0
    :param start: how the first samples start from the actor's action; None for the prior's samples alone
    :raises ValueError: if an argument is out of its range
    """

    iterations: int = 2
    samples: int = 64
    elites: int = 6
    result: str = "mean"
    temperature: float = 0.5
    start: ActorStart | None = None

    def __post_init__(self) -> None:
        check_cem(self.iterations, self.samples, self.elites, self.result)
        require_number("temperature", self.temperature)
        require(self.temperature > 0, "temperature", self.temperature, "above 0")
        is_start = self.start is None or isinstance(self.start, ActorStart)
        require(is_start, "start", self.start, "None, or an instance of sb3_cgp.selectors.ActorStart")

    @property
    def takes_proposals(self) -> bool:
        """Whether the first samples start from the actor's action."""
        return self.start is not None

    @th.no_grad()
    def select(
        self,
        score: Score,
        n_states: int,
        action_dim: int,
        device: th.device | str = "cpu",
        proposals: th.Tensor | None = None,
    ) -> Selection:
        """
        Maximise ``score`` for each state, with random numbers of PyTorch's global generator.

        The parameters are those of :class:`~sb3_cgp.selectors.ProposalSelector`. A NaN score ranks last, and one that is not
        finite has no weight where another elite's is finite.

        :return: the selected actions (B, A) and the last elites (B, K, A)
        """
        shape = (n_states, self.samples, action_dim)
        samples = th.randn(shape, device=device)
        if self.start is None or proposals is None:
            actions = samples.tanh()
        else:
            samples, actions = self.start.first_samples(samples, proposals)
        winners, weights = self._weigh_elites(score(actions))
        for _ in range(self.iterations - 1):
            mean, std = fit_weighted_gaussian(take(samples, winners), weights)
            samples = th.addcmul(mean, std, th.randn(shape, device=device))
            actions = samples.tanh()
            winners, weights = self._weigh_elites(score(actions))
        elites = take(samples, winners)
        if self.result == "best":
            return Selection(actions=take(actions, winners[:, :1]).squeeze(1), elites=elites)
        mean, _ = fit_weighted_gaussian(elites, weights)
        return Selection(actions=mean.squeeze(1).tanh(), elites=elites)

    def _weigh_elites(self, values: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Return the elites' indices, best first, and their weights, the softmax of standardised values: (B, K, 1) each."""
        winners = find_elites(values, self.elites)
        is_finite = values.isfinite()
        number = is_finite.sum(dim=1, keepdim=True).clamp(min=1)
        mean = values.where(is_finite, 0.0).sum(dim=1, keepdim=True) / number
        deviations = (values - mean).where(is_finite, 0.0)
        scale = (deviations.square().sum(dim=1, keepdim=True) / number).sqrt().unsqueeze(2) * self.temperature
        elites = take(values.where(is_finite, -th.inf).unsqueeze(2), winners)
        # Where all values are equal, the scale is 0, and so are all differences
        differences = (elites - elites.amax(dim=1, keepdim=True)) / scale.clamp(min=th.finfo(scale.dtype).tiny)
        weights = differences.softmax(dim=1)
        # Equal ones where no elite's value is finite
        return winners, weights.where(weights.isfinite().all(dim=1, keepdim=True), 1 / self.elites)


def fit_weighted_gaussian(elites: th.Tensor, weights: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """
    Fit independent Gaussians to weighted elites.

    :param elites: samples before tanh, (B, K, A)
    :param weights: their weights, which sum to 1 for each state, (B, K, 1)
    :return: mean and standard deviation, (B, 1, A) each
    """
    mean = (weights * elites).sum(dim=1, keepdim=True)
    return mean, (weights * (elites - mean).square()).sum(dim=1, keepdim=True).sqrt()
