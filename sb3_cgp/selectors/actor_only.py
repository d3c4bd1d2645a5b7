"""The actor alone as a selector: without a search, CGP is TD3 or DDPG."""

from dataclasses import dataclass

import torch as th

from sb3_cgp.common.rules import require
from sb3_cgp.core.cem import Score, Selection
from sb3_cgp.selectors.proposals import before_tanh


@dataclass
class ActorOnly:
    """
    Selects the actor's action, and never evaluates the critic.

    With it, ``CGP(..., policy_loss="qgp", policy_delay=2)`` is TD3, and a comparison with CEM leaves all else equal. Its
    rollouts explore by ``action_noise`` alone, as TD3's do.
    """

    takes_proposals = True

    def select(
        self,
        score: Score,
        n_states: int,
        action_dim: int,
        device: th.device | str = "cpu",
        proposals: th.Tensor | None = None,
    ) -> Selection:
        """
        Return the first proposal for each state.

        The parameters are those of :class:`~sb3_cgp.selectors.ProposalSelector`.

        :return: the actor's actions (B, A), and the same before tanh as the only elites (B, 1, A)
        :raises ValueError: if there are no proposals
        """
        allowed = "the actions of a trained actor, for which CGP needs policy_training='online' and a `policy_loss`"
        require(proposals is not None, "proposals", proposals, allowed)
        assert proposals is not None
        return Selection(actions=proposals[:, 0], elites=before_tanh(proposals[:, :1]))
