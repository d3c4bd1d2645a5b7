"""CGP with an argument for the data type in which CEM evaluates the critic."""

from typing import ClassVar

from sb3_cgp.common.rules import require, require_choice
from sb3_cgp.fast.scoring import SCORING_DTYPES
from sb3_cgp.selectors.algorithm import SelectorAlgorithm


class ScoringAlgorithm(SelectorAlgorithm):
    """CGP whose policy evaluates the critic in ``cem_dtype`` for CEM, an argument that may be changed on the model."""

    # The argument of the constructor
    cem_dtype: str = "auto"

    changeable_arguments: ClassVar[dict[str, str | None]] = {
        **SelectorAlgorithm.changeable_arguments,
        "cem_dtype": "_choose_dtype",
    }

    def _setup_model(self) -> None:
        given = self.policy_kwargs.get("cem_dtype")
        require(given is None, "policy_kwargs['cem_dtype']", given, "given as `cem_dtype`, outside `policy_kwargs`")
        super()._setup_model()
        self._choose_dtype()

    def _check_arguments(self) -> None:
        super()._check_arguments()
        require_choice("cem_dtype", self.cem_dtype, SCORING_DTYPES)

    def _choose_dtype(self) -> None:
        self.policy.cem_dtype = self.cem_dtype  # type: ignore[assignment]
