"""CGP whose CEM may start from the actor, and whose selector may be changed on the model."""

import warnings
from typing import Any, ClassVar

from stable_baselines3.common.callbacks import BaseCallback

from sb3_cgp.common.rules import require, require_choice
from sb3_cgp.core.cem import CEM, ActionSelector
from sb3_cgp.selectors.actor_cem import ActorCEM
from sb3_cgp.selectors.actor_only import ActorOnly
from sb3_cgp.selectors.changes import ChangeableAlgorithm
from sb3_cgp.selectors.policies import CGPPolicy
from sb3_cgp.selectors.proposals import ActorStart, check_start, takes_proposals

STARTS = ("prior", "actor")
# The arguments of which the selector is made, with their defaults
CEM_ARGUMENTS = {"cem_start": "prior"} | {f"cem_{name}": value for name, value in (vars(ActorCEM()) | vars(CEM())).items()}


class SelectorAlgorithm(ChangeableAlgorithm):
    """
    CGP whose CEM starts from the prior, as in the paper, or from the actor.

    Acting and the policy's loss start from the actor, bootstrap actions from the averaged actor. While the critics have learnt
    and the actor has not, as in ``learn`` with ``policy_training="offline"``, all samples are the prior's. The offline
    training itself starts from the actor that it trains.

    Another selector that is set on the policy takes effect at once, in the place of the arguments of CEM. It is saved with the
    model, and checked at the next ``learn``.
    """

    # The arguments of the constructor
    cem_start: str = "prior"
    cem_actor_fraction: float = 0.5
    cem_actor_std: float = 0.3

    changeable_arguments: ClassVar[dict[str, str | None]] = {
        **ChangeableAlgorithm.changeable_arguments,
        **dict.fromkeys(CEM_ARGUMENTS),
    }

    def _setup_model(self) -> None:
        given = self.policy_kwargs.get("actor_proposes")
        require(given is None, "policy_kwargs['actor_proposes']", given, "left out: CGP sets it when the actor is trained")
        super()._setup_model()
        self._initial_selector = self.policy.selector
        if "_saved_selector" in vars(self):
            saved = self._saved_selector
            self.policy.selector = self._make_selector() if saved is None else saved
        elif self.cem_start == "actor":
            allowed = "'prior' with a selector of `policy_kwargs` or of the policy's class, which replaces CEM"
            require(self._selector_follows_arguments, "cem_start", self.cem_start, allowed)
        self._check_selector()
        self._warn_if_replaced(*(name for name, default in CEM_ARGUMENTS.items() if getattr(self, name) != default))

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        # The user may have set another selector on the policy
        self._check_selector()
        return super()._setup_learn(*args, **kwargs)

    @property
    def _selector_follows_arguments(self) -> bool:
        """Whether the selector equals the one that the arguments of CEM make, and not one that replaces it."""
        selector, made = self.policy.selector, self._make_selector()
        return type(selector) is type(made) and selector == made

    def save(self, *args: Any, **kwargs: Any) -> None:
        """
        Save the model, with a selector that has been set on its policy, see SB3's method.

        :param args: the arguments of SB3's method
        :param kwargs: the same arguments by keyword
        """
        selector = self.policy.selector
        if selector is self._initial_selector and type(selector) not in (CEM, ActorCEM):
            # The constructor makes it again, and it may refer to the policy
            vars(self).pop("_saved_selector", None)
        else:
            self._saved_selector = None if self._selector_follows_arguments else selector
        super().save(*args, **kwargs)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_initial_selector"]

    def _change_argument(self, name: str, value: Any) -> None:
        selector, follows_arguments = self.policy.selector, self._selector_follows_arguments
        super()._change_argument(name, value)
        try:
            if follows_arguments:
                self.policy.selector = self._make_selector()
            self._check_selector()
        except ValueError:
            self.policy.selector = selector
            raise
        if name in CEM_ARGUMENTS:
            self._warn_if_replaced(name)

    def _check_arguments(self) -> None:
        super()._check_arguments()
        require_choice("cem_start", self.cem_start, STARTS)
        check_start(self.cem_actor_fraction, self.cem_actor_std, prefix="cem_actor_")

    def _check_selector(self) -> None:
        """Check that the selector fits the policy and the arguments."""
        selector = self.policy.selector
        is_selector = not isinstance(selector, type) and callable(getattr(selector, "select", None))
        require(is_selector, "selector", selector, "an instance with a method `select`, such as sb3_cgp.selectors.MPPI()")
        allowed = "a subclass of sb3_cgp.CGPPolicy, whose actor can propose actions to the selector"
        # `torch.compile` returns a policy of a class of its own
        proposes = issubclass(self.policy_class, CGPPolicy)
        require(proposes or not takes_proposals(selector), "policy", self.policy_class, allowed)
        if self.policy_loss is None:
            require(self.cem_start == "prior", "cem_start", self.cem_start, "'prior' where `policy_loss=None` trains no actor")
            starts = isinstance(getattr(selector, "start", None), ActorStart)
            require(
                not starts, "selector", selector, "one that starts from the prior where `policy_loss=None` trains no actor"
            )
        self._check_imitation()
        if isinstance(selector, ActorOnly):
            reason = "with the selector ActorOnly(), whose actions are the actor's own"
            require(self.policy_loss == "qgp", "policy_loss", self.policy_loss, f"'qgp' {reason}")
            require(self._trains_online, "policy_training", self.policy_training, f"'online' {reason}")

    def _check_imitation(self) -> None:
        """Check that an actor which imitates the selector is shown other actions than its own."""
        selector = self.policy.selector
        start, samples = getattr(selector, "start", None), getattr(selector, "samples", None)
        # A selector of the user's may call their number otherwise
        if self.policy_loss != "cgp" or not isinstance(start, ActorStart) or samples is None:
            return
        is_useful = start.leaves_others(samples)
        reason = "policy_loss='cgp', as an actor that imitates itself learns nothing"
        if self._selector_follows_arguments:
            require(samples > 1, "cem_samples", samples, f"at least 2 with cem_start='actor' and {reason}")
            allowed = f"greater than 0, or `cem_actor_fraction` smaller, with cem_start='actor' and {reason}"
            require(is_useful, "cem_actor_std", start.std, allowed)
        require(is_useful, "selector", selector, f"one with samples that differ from the actor's action with {reason}")

    def _warn_if_replaced(self, *names: str) -> None:
        """Warn that arguments of CEM have no effect where another selector replaces CEM."""
        if names and not self._selector_follows_arguments:
            arguments = ", ".join(f"{name}={getattr(self, name)!r}" for name in names)
            warnings.warn(
                f"{arguments} has no effect, as the selector {self.policy.selector} replaces CEM: set the selector's own "
                "arguments.",
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
