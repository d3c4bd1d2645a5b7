"""CGP whose CEM may start from the actor."""

from sb3_cgp.common.rules import require, require_choice
from sb3_cgp.core.cem import ActionSelector
from sb3_cgp.core.cgp import CGP
from sb3_cgp.selectors.actor_cem import ActorCEM
from sb3_cgp.selectors.actor_only import ActorOnly
from sb3_cgp.selectors.policies import CGPPolicy
from sb3_cgp.selectors.proposals import check_start, takes_proposals

STARTS = ("prior", "actor")


class SelectorAlgorithm(CGP):
    """
    CGP whose CEM starts from the prior, as in the paper, or from the actor.

    Acting and the policy's loss start from the actor, bootstrap actions from the averaged actor. All samples are the prior's
    while the critics have learnt and the actor has not, as in offline training.
    """

    # The arguments of the constructor
    cem_start: str = "prior"
    cem_actor_fraction: float = 0.5
    cem_actor_std: float = 0.3

    def _setup_model(self) -> None:
        require_choice("cem_start", self.cem_start, STARTS)
        check_start(self.cem_actor_fraction, self.cem_actor_std, prefix="cem_actor_")
        given = self.policy_kwargs.get("actor_proposes")
        require(given is None, "policy_kwargs['actor_proposes']", given, "left out: CGP sets it when the actor is trained")
        super()._setup_model()
        if self.cem_start == "actor":
            self._check_actor_start()
        allowed = "a subclass of sb3_cgp.CGPPolicy, whose actor can propose actions to the selector"
        require(
            isinstance(self.policy, CGPPolicy) or not takes_proposals(self.policy.selector),
            "policy",
            self.policy_class,
            allowed,
        )
        if isinstance(self.policy.selector, ActorOnly):
            reason = "with the selector ActorOnly(), whose actions are the actor's own"
            require(self.policy_loss == "qgp", "policy_loss", self.policy_loss, f"'qgp' {reason}")
            require(self._trains_online, "policy_training", self.policy_training, f"'online' {reason}")

    def _check_actor_start(self) -> None:
        """Check that an actor is trained, that the selector is CEM, and that not all of its samples are the actor's action."""
        allowed = "'prior' where `policy_loss=None` trains no actor"
        require(self.policy_loss is not None, "cem_start", self.cem_start, allowed)
        selector = self.policy.selector
        is_ours = self.policy_kwargs.get("selector") is None and isinstance(selector, ActorCEM)
        allowed = "'prior' with a selector of `policy_kwargs` or of the policy's class, which replaces CEM"
        require(is_ours, "cem_start", self.cem_start, allowed)
        assert isinstance(selector, ActorCEM)
        if self.policy_loss == "cgp":
            reason = "with cem_start='actor' and policy_loss='cgp', as an actor that imitates itself learns nothing"
            require(self.cem_samples > 1, "cem_samples", self.cem_samples, f"at least 2 {reason}")
            has_others = self.cem_actor_std > 0 or selector.start.n_around(self.cem_samples) < self.cem_samples - 1
            allowed = f"greater than 0, or `cem_actor_fraction` smaller, {reason}"
            require(has_others, "cem_actor_std", self.cem_actor_std, allowed)

    def _make_selector(self) -> ActionSelector:
        if self.cem_start == "prior":
            return super()._make_selector()
        sizes = self.cem_iterations, self.cem_samples, self.cem_elites, self.cem_result
        return ActorCEM(*sizes, self.cem_actor_fraction, self.cem_actor_std)

    def _choose_inference(self) -> None:
        super()._choose_inference()
        self.policy.actor_proposes = self._has_actor  # type: ignore[assignment]
