"""Action selectors besides the paper's CEM, among them those that start from the actor's action."""

from sb3_cgp.selectors.actor_cem import ActorCEM
from sb3_cgp.selectors.actor_only import ActorOnly
from sb3_cgp.selectors.mppi import MPPI
from sb3_cgp.selectors.proposals import ActorStart, ProposalSelector

__all__ = ["MPPI", "ActorCEM", "ActorOnly", "ActorStart", "ProposalSelector"]
