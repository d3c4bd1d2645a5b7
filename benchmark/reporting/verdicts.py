"""Verdicts on claims: a claim rests on comparisons, each of which is judged by its interval."""

from dataclasses import dataclass

import numpy as np

from benchmark.reporting.estimates import FEWEST_RUNS, Estimate

# The method that the claims are about
OURS = "CGP-Online"
# The same with the light setting of CEM, which starts from the actor
LIGHT = "CGP-Light"
# The methods that a figure with room for a few shows, those of them that a study ran
SHOWN_FIRST = (OURS, LIGHT, "TD3", "SAC")
SUPPORTED, CONTRADICTED = "supported", "contradicted"
NOT_DECIDED, NO_DATA = "not decided by these data", "no data"
# Of a comparison of which nothing is concluded yet
TOO_FEW = "too few seeds"
# The difference that counts as none, as a share of the task's range
MARGIN = 0.05


@dataclass(frozen=True)
class Part:
    """
    One comparison that a claim rests on.

    :param text: the comparison and its result
    :param verdict: the verdict on the claim
    :param note: a further result, on which the verdict does not rest
    """

    text: str
    verdict: str
    note: str = ""

    @property
    def whole_text(self) -> str:
        """The comparison with its note."""
        return self.text + f" ({self.note})" * bool(self.note)


@dataclass(frozen=True)
class Finding:
    """
    The finding on a claim.

    :param claim: the paper's claim
    :param parts: the comparisons that it rests on; none without data
    """

    claim: str
    parts: list[Part]

    @property
    def verdict(self) -> str:
        """The verdict of all parts together."""
        verdicts = [part.verdict for part in self.parts]
        if not verdicts:
            return NO_DATA
        if CONTRADICTED in verdicts:
            return CONTRADICTED
        return SUPPORTED if set(verdicts) == {SUPPORTED} else NOT_DECIDED

    @property
    def evidence(self) -> str:
        """The comparison that the verdict rests on: of several, the first with the verdict of all together."""
        with_seeds = [part for part in self.parts if part.verdict != TOO_FEW]
        alike = [part for part in with_seeds if part.verdict == self.verdict]
        if not alike:
            # Where the others are supported, those with too few seeds leave the claim undecided
            return next((part.text for part in self.parts if part.verdict == TOO_FEW), "")
        counted = f"; {self.verdict} in {len(alike)} of {len(with_seeds)} comparisons"
        return alike[0].text + counted * (len(with_seeds) > 1)


def judge(found: Estimate, more_than: float = -np.inf, less_than: float = np.inf) -> str:
    """
    Compare an interval with the bounds of a claim.

    :param found: the estimate
    :param more_than: the lower bound
    :param less_than: the upper bound
    :return: the verdict
    """
    if found.interval is None or found.runs < FEWEST_RUNS:
        return NOT_DECIDED
    low, high = found.interval
    if low > more_than and high < less_than:
        return SUPPORTED
    return CONTRADICTED if high < more_than or low > less_than else NOT_DECIDED
