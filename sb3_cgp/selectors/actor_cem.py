"""
The Cross-Entropy Method that starts from the actor's action.

Shapes: B states, P proposals, N samples and K elites per state, A action dimensions.
"""

from dataclasses import dataclass

import torch as th

from sb3_cgp.core.cem import CEM, Score, Selection, find_elites, fit_gaussian, take
from sb3_cgp.selectors.proposals import ActorStart, check_start


@dataclass
class ActorCEM(CEM):
    """
    CEM whose first samples include the actor's action, and samples around it.

    It needs fewer samples than the paper's CEM, as the actor knows nearly where the best action is. The best sample so far
    is one of the next iteration's samples. Without proposals, it is the paper's CEM.

    :param iterations: number of iterations, at least 1
    :param samples: number of samples per state and iteration, at least 1
    :param elites: number of best samples to which the next Gaussian is fitted, from 1 to ``samples``
    :param result: "best" returns the best sample, "mean" the mean of the last elites
    :param actor_fraction: share of the samples that is drawn around the actor's action, from 0 to 1
    :param actor_std: standard deviation of these samples, before tanh
    :raises ValueError: if an argument is out of its range
    """

    takes_proposals = True

    iterations: int = 1
    samples: int = 16
    actor_fraction: float = 0.5
    actor_std: float = 0.3

    def __post_init__(self) -> None:
        super().__post_init__()
        check_start(self.actor_fraction, self.actor_std, prefix="actor_")

    @property
    def start(self) -> ActorStart:
        """How the first samples start from the actor's action."""
        return ActorStart(self.actor_fraction, self.actor_std)

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

        The parameters are those of :class:`~sb3_cgp.selectors.ProposalSelector`. A NaN score ranks last.

        :return: the selected actions (B, A) and the last elites (B, K, A)
        """
        if proposals is None:
            return super().select(score, n_states, action_dim, device)
        shape = (n_states, self.samples, action_dim)
        samples, actions = self.start.first_samples(th.randn(shape, device=device), proposals)
        elites, elite_actions = self._keep_elites(score, samples, actions)
        for _ in range(self.iterations - 1):
            mean, std = fit_gaussian(elites)
            samples = th.addcmul(mean, std, th.randn(shape, device=device))
            samples[:, 0] = elites[:, 0]
            actions = samples.tanh()
            actions[:, 0] = elite_actions[:, 0]
            elites, elite_actions = self._keep_elites(score, samples, actions)
        selected = elite_actions[:, 0] if self.result == "best" else elites.mean(dim=1).tanh()
        return Selection(actions=selected, elites=elites)

    def _keep_elites(self, score: Score, samples: th.Tensor, actions: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Return the elites of samples before tanh, (B, N, A), and of their actions, (B, N, A), best first: (B, K, A)."""
        winners = find_elites(score(actions), self.elites)
        return take(samples, winners), take(actions, winners)
