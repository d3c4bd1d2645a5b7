"""Attributes that neither a saved model nor a copy has: those of its running training, and what cannot be copied."""

from typing import Any, ClassVar

from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm


class TransientAttributes(OffPolicyAlgorithm):
    """
    An algorithm that leaves some attributes out of saved models and of copies.

    Each class lists its own in ``TRANSIENT``. The value in a copy is a class attribute of the same name, or one that
    ``__setstate__`` makes.
    """

    TRANSIENT: ClassVar[tuple[str, ...]] = ()

    def _transient_attributes(self) -> set[str]:
        return {name for each in type(self).__mro__ for name in vars(each).get("TRANSIENT", ())}

    def __getstate__(self) -> dict[str, Any]:
        # Of the classes after this one. Python has a method of this name since 3.11.
        inherited = getattr(super(), "__getstate__", None)
        state: dict[str, Any] = vars(self) if inherited is None else inherited()
        transient = self._transient_attributes()
        return {name: value for name, value in state.items() if name not in transient}

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), *self._transient_attributes()]
