"""Arguments of CGP that may be changed on the model."""

from typing import Any, ClassVar

from sb3_cgp.core.cgp import CGP


class ChangeableAlgorithm(CGP):
    """
    CGP whose ``changeable_arguments`` may be changed on the model, also by a callback.

    They are checked, and take effect at once. Others are attributes as in SB3.
    """

    # The arguments, each with the method that lets the policy follow its change; None where there is nothing more to do
    changeable_arguments: ClassVar[dict[str, str | None]] = {
        **dict.fromkeys(("policy_loss", "policy_training", "policy_delay", "actor_learning_rate")),
        **dict.fromkeys(("target_update_interval", "target_policy_noise", "target_noise_clip")),
        "inference": "_choose_inference",
        "learning_rate": "_setup_lr_schedule",
    }

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
        before, had_actor = getattr(self, name), self._has_actor
        try:
            self._change_argument(name, value)
        except ValueError:
            super().__setattr__(name, before)
            raise
        if self._has_actor != had_actor:
            self._choose_inference()
        # Of no other argument: the user may have chosen otherwise on the policy
        if follow := self.changeable_arguments[name]:
            getattr(self, follow)()

    def _change_argument(self, name: str, value: Any) -> None:
        """Set an argument, and check it with the others; subclasses extend this."""
        super().__setattr__(name, value)
        self._check_arguments()
