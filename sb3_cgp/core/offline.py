"""The convergence rule of a policy's offline training."""

import math

# The paper says "to convergence": the rule and its numbers are this package's choice
ROUND = 1_000  # gradient steps per round
PATIENCE = 5  # rounds in a row without an improvement
TOLERANCE = 0.05  # smallest relative fall of the loss that counts as an improvement


class Plateau:
    """Detects that a loss no longer falls: ``PATIENCE`` rounds in a row did not improve on the lowest loss before them."""

    def __init__(self) -> None:
        self.lowest = math.inf
        self.rounds_without_improvement = 0

    def reached(self, loss: float) -> bool:
        """
        Return whether the loss no longer falls, given the mean loss of one more round.

        :param loss: the round's mean loss
        :return: whether the policy's training ends
        """
        if math.isinf(self.lowest) or loss < self.lowest - TOLERANCE * abs(self.lowest):
            self.lowest = loss
            self.rounds_without_improvement = 0
        else:
            self.rounds_without_improvement += 1
        return self.rounds_without_improvement >= PATIENCE
