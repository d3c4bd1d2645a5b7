"""CGP whose CEM may start from the actor, and whose arguments may be changed on the model."""

import warnings
from typing import Any, ClassVar

from sb3_cgp.common.rules import require, require_choice
from sb3_cgp.core.cem import CEM, ActionSelector
from sb3_cgp.core.cgp import CGP
from sb3_cgp.selectors.actor_cem import ActorCEM
from sb3_cgp.selectors.actor_only import ActorOnly
from sb3_cgp.selectors.policies import CGPPolicy
from sb3_cgp.selectors.proposals import ActorStart, check_start, takes_proposals

STARTS = ("prior", "actor")


class SelectorAlgorithm(CGP):
    """
    CGP whose CEM starts from the prior, as in the paper, or from the actor.

    Acting and the policy's loss start from the actor, bootstrap actions from the averaged actor. While the critics have learnt
    and the actor has not, as in ``learn`` with ``policy_training="offline"``, all samples are the prior's. The offline
    training itself starts from the actor that it trains.

    The ``changeable_arguments`` may be changed on the model, also by a callback: they are checked, and take effect at once.
    So does another selector that is set on the policy, which is then saved with the model.
    """

    # The arguments of the constructor
    cem_start: str = "prior"
    cem_actor_fraction: float = 0.5
    cem_actor_std: float = 0.3

    # The arguments that are checked and followed when they are changed on a model
    changeable_arguments: ClassVar[tuple[str, ...]] = (
        *("cem_iterations", "cem_samples", "cem_elites", "cem_result", "cem_start", "cem_actor_fraction", "cem_actor_std"),
        *("policy_loss", "policy_training", "policy_delay", "inference"),
        *("target_update_interval", "target_policy_noise", "target_noise_clip"),
    )

    def _setup_model(self) -> None:
        given = self.policy_kwargs.get("actor_proposes")
        require(given is None, "policy_kwargs['actor_proposes']", given, "left out: CGP sets it when the actor is trained")
        super()._setup_model()
        self._check_selector()
        self._initial_selector = self.policy.selector

    def save(self, *args: Any, **kwargs: Any) -> None:
        """
        Save the model, with a selector that has been set on its policy, see SB3's method.

        :param args: the arguments of SB3's method
        :param kwargs: the same arguments by keyword
        """
        selector = self.policy.selector
        if selector is not self._initial_selector and selector != self._make_selector():
            self.policy_kwargs, self._initial_selector = self.policy_kwargs | {"selector": selector}, selector
        super().save(*args, **kwargs)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_initial_selector"]

    def __setattr__(self, name: str, value: Any) -> None:
        """
        Set an attribute. An argument of CGP that is changed on a model takes effect at once; after an error it is unchanged.

        :param name: the attribute's name
        :param value: its value
        :raises ValueError: if the argument is out of its range or contradicts another one
        """
        if name not in self.changeable_arguments or "policy" not in vars(self):
            super().__setattr__(name, value)
            return
        before, selector = getattr(self, name), self.policy.selector
        is_made_here = self.policy_kwargs.get("selector") is None and selector == self._make_selector()
        super().__setattr__(name, value)
        try:
            self._check_arguments()
            if is_made_here:
                self.policy.selector = self._make_selector()
            self._check_selector()
        except ValueError:
            super().__setattr__(name, before)
            self.policy.selector = selector
            raise
        self._follow_arguments()

    def _follow_arguments(self) -> None:
        """Set what the policy has of the arguments, besides the selector."""
        self._choose_inference()

    def _check_arguments(self) -> None:
        super()._check_arguments()
        require_choice("cem_start", self.cem_start, STARTS)
        check_start(self.cem_actor_fraction, self.cem_actor_std, prefix="cem_actor_")

    def _check_selector(self) -> None:
        """Check that the selector fits the policy and the arguments, and warn of arguments that it replaces."""
        selector = self.policy.selector
        is_selector = not isinstance(selector, type) and callable(getattr(selector, "select", None))
        require(is_selector, "selector", selector, "an instance with a method `select`, such as sb3_cgp.selectors.MPPI()")
        allowed = "a subclass of sb3_cgp.CGPPolicy, whose actor can propose actions to the selector"
        proposes = isinstance(self.policy, CGPPolicy)
        require(proposes or not takes_proposals(selector), "policy", self.policy_class, allowed)
        if self.cem_start == "actor":
            allowed = "'prior' where `policy_loss=None` trains no actor"
            require(self.policy_loss is not None, "cem_start", self.cem_start, allowed)
            is_ours = self.policy_kwargs.get("selector") is None and isinstance(selector, ActorCEM)
            allowed = "'prior' with a selector of `policy_kwargs` or of the policy's class, which replaces CEM"
            require(is_ours, "cem_start", self.cem_start, allowed)
        self._check_imitation()
        if isinstance(selector, ActorOnly):
            reason = "with the selector ActorOnly(), whose actions are the actor's own"
            require(self.policy_loss == "qgp", "policy_loss", self.policy_loss, f"'qgp' {reason}")
            require(self._trains_online, "policy_training", self.policy_training, f"'online' {reason}")
        self._warn_of_replaced_arguments()

    def _check_imitation(self) -> None:
        """Check that an actor which imitates the selector is shown other actions than its own."""
        selector = self.policy.selector
        start, samples = getattr(selector, "start", None), getattr(selector, "samples", 0)
        if self.policy_loss != "cgp" or not isinstance(start, ActorStart):
            return
        is_useful = start.leaves_others(samples)
        reason = "policy_loss='cgp', as an actor that imitates itself learns nothing"
        if self.cem_start == "actor":
            require(samples > 1, "cem_samples", samples, f"at least 2 with cem_start='actor' and {reason}")
            allowed = f"greater than 0, or `cem_actor_fraction` smaller, with cem_start='actor' and {reason}"
            require(is_useful, "cem_actor_std", start.std, allowed)
        require(is_useful, "selector", selector, f"one with samples that differ from the actor's action with {reason}")

    def _warn_of_replaced_arguments(self) -> None:
        """Warn of arguments of CEM that have no effect, as a selector of the user's replaces CEM."""
        if self.policy_kwargs.get("selector") is None:
            return
        defaults = vars(CEM())
        values = {f"cem_{name}": getattr(self, f"cem_{name}") for name in defaults}
        changed = [f"{name}={value!r}" for name, value in values.items() if value != defaults[name.removeprefix("cem_")]]
        if changed:
            warnings.warn(
                f"{', '.join(changed)} has no effect, as the selector {self.policy.selector} replaces CEM: set the selector's "
                "own arguments.",
                stacklevel=2,
            )

    def _make_selector(self) -> ActionSelector:
        if self.cem_start == "prior":
            return super()._make_selector()
        sizes = self.cem_iterations, self.cem_samples, self.cem_elites, self.cem_result
        return ActorCEM(*sizes, self.cem_actor_fraction, self.cem_actor_std)

    def _choose_inference(self) -> None:
        super()._choose_inference()
        self.policy.actor_proposes = self._has_actor  # type: ignore[assignment]
