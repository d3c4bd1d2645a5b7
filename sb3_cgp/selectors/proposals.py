"""
Proposals: actions that a selector takes into its first samples, such as the actor's.

Shapes: B states, P proposals and N samples per state, A action dimensions.
"""

from dataclasses import dataclass
from typing import Any, Protocol

import torch as th

from sb3_cgp.common.rules import require_number
from sb3_cgp.core.cem import ActionSelector, Score, Selection

# Larger magnitudes of a proposal are clipped before samples are drawn around it: tanh would map all of them to the same action
SATURATION = 0.99


class ProposalSelector(ActionSelector, Protocol):
    """An action selector that can be given proposals: its first samples include them."""

    # Whether this instance wants proposals
    takes_proposals: bool

    def select(
        self,
        score: Score,
        n_states: int,
        action_dim: int,
        device: th.device | str = "cpu",
        proposals: th.Tensor | None = None,
    ) -> Selection:
        """
        Select an action for each state.

        :param score: scores N actions per state: (B, N, A) within [-1, 1] -> (B, N)
        :param n_states: number of states, B
        :param action_dim: number of action dimensions, A
        :param device: the device of ``score``
        :param proposals: actions within [-1, 1], (B, P, A); None where there is no trained actor
        :return: the selected actions and the elites
        """


@dataclass(frozen=True)
class ActorStart:
    """
    The rule by which the first samples start from proposals: the proposals themselves, a share around them, and the rest
    from the prior, whose samples let the search leave a bad actor's action.

    :param fraction: share of the samples that is drawn around the proposals, from 0 to 1; none are left for the prior at 1
    :param std: standard deviation of these samples, before tanh
    :raises ValueError: if an argument is out of its range
    """

    fraction: float = 0.5
    std: float = 0.3

    def __post_init__(self) -> None:
        check_start(self.fraction, self.std)

    def n_around(self, n_samples: int, n_proposals: int = 1) -> int:
        """
        Return how many samples are drawn around the proposals.

        :param n_samples: number of samples, N
        :param n_proposals: number of proposals among them, P
        :return: ``fraction`` of all N samples, rounded, and at most the N - P that the proposals leave
        """
        return min(round(self.fraction * n_samples), n_samples - n_proposals)

    def leaves_others(self, n_samples: int) -> bool:
        """
        Return whether some samples may differ from a single proposal.

        :param n_samples: number of samples, N
        :return: False if all of them are the proposal itself, so that a search finds nothing else
        """
        return n_samples > 1 and (self.std > 0 or self.n_around(n_samples) < n_samples - 1)

    def first_samples(self, samples: th.Tensor, proposals: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        Make first samples from standard normal ones.

        :param samples: samples of the prior, before tanh, (B, N, A); overwritten
        :param proposals: actions within [-1, 1], (B, P, A), of which the first N are used
        :return: the samples before tanh, (B, N, A), in the order proposals, around them, prior; and their actions, (B, N, A),
            which hold the proposals as they are
        """
        proposals = proposals[:, : samples.shape[1]]
        n_proposals = proposals.shape[1]
        n_around = self.n_around(samples.shape[1], n_proposals)
        around = slice(n_proposals, n_proposals + n_around)
        centres = before_tanh(proposals)
        samples[:, :n_proposals] = centres
        samples[:, around].mul_(self.std).add_(_in_turn(centres, n_around))
        actions = samples.tanh()
        actions[:, :n_proposals] = proposals
        if self.std == 0:
            # The proposals again, and not the clipped ones
            actions[:, around] = _in_turn(proposals, n_around)
        return samples, actions


def _in_turn(proposals: th.Tensor, n: int) -> th.Tensor:
    """Return ``n`` proposals for each state, each in turn, (B, n, A). One alone, (B, 1, A), is left to be broadcast."""
    n_proposals = proposals.shape[1]
    return proposals if n_proposals == 1 else proposals.repeat(1, -(-n // n_proposals), 1)[:, :n]


def takes_proposals(selector: Any) -> bool:
    """
    Return whether a selector wants proposals.

    :param selector: the selector; one without the attribute of :class:`ProposalSelector` wants none
    :return: whether it does
    """
    return bool(getattr(selector, "takes_proposals", False))


def before_tanh(actions: th.Tensor) -> th.Tensor:
    """
    Return the values before tanh of actions, which are clipped at a magnitude of ``SATURATION``.

    :param actions: actions within [-1, 1]
    :return: the values, of the same shape
    """
    return actions.clamp(-SATURATION, SATURATION).atanh()


def check_start(fraction: float, std: float, prefix: str = "") -> None:
    """
    Check the arguments of :class:`ActorStart`.

    :param fraction: share of the samples around the proposals
    :param std: their standard deviation
    :param prefix: precedes the names in errors
    :raises ValueError: if an argument is out of its range
    """
    require_number(f"{prefix}fraction", fraction, high=1.0)
    require_number(f"{prefix}std", std)
