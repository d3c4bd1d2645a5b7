"""CGP's policy whose actor proposes its action to the selector."""

from typing import Any

from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_cgp.common.networks import evaluation_mode
from sb3_cgp.common.rules import require
from sb3_cgp.core import policies
from sb3_cgp.selectors.actor_only import ActorOnly
from sb3_cgp.selectors.proposals import takes_proposals


class CGPPolicy(policies.CGPPolicy):
    """
    Policy class of CGP whose actor's action is proposed to selectors that take proposals.

    :param args: the arguments of :class:`sb3_cgp.core.policies.CGPPolicy`, and of SB3's ``TD3Policy``
    :param actor_proposes: whether the actor is trained, so that its actions are worth a proposal
    :param kwargs: the same arguments by keyword
    :raises ValueError: if ``actor_proposes`` is no bool
    """

    def __init__(self, *args: Any, actor_proposes: bool = True, **kwargs: Any):
        require(isinstance(actor_proposes, bool), "actor_proposes", actor_proposes, "True or False")
        super().__init__(*args, **kwargs)
        self.actor_proposes = actor_proposes

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return super()._get_constructor_parameters() | dict(actor_proposes=self.actor_proposes)

    def selector_arguments(self, observation: PyTorchObs, critic: ContinuousCritic) -> dict[str, Any]:
        """
        Return proposals for a selector that takes them: the averaged actor's action for the target critic, else the actor's.

        :param observation: a batch of B observations, as tensors
        :param critic: the critic, or the target critic
        :return: ``proposals``, (B, 1, A), or None while no actor is trained; nothing for other selectors
        """
        if not takes_proposals(self.selector):
            return {}
        # ActorOnly has no other actions to begin with
        if not self.actor_proposes and not isinstance(self.selector, ActorOnly):
            return {"proposals": None}
        actor = self.actor_target if critic is self.critic_target else self.actor
        with evaluation_mode(actor):
            return {"proposals": actor(observation).unsqueeze(1)}
