"""The convergence rule of a policy's offline training."""

import math

# Gradient steps per round. The paper says "to convergence": the rule and its numbers are this package's choice.
ROUND = 1_000


class Plateau:
    """
    Detects that a loss no longer falls: for ``patience`` rounds in a row, no loss was below the lowest loss before them
    by more than ``tolerance`` times its magnitude.

    :param patience: number of rounds without an improvement, at least 1
    :param tolerance: smallest relative fall of the loss that counts as an improvement
    """

    def __init__(self, patience: int = 5, tolerance: float = 0.05):
        self.patience = patience
        self.tolerance = tolerance
        self.lowest = math.inf
        self.rounds_without_improvement = 0

    def reached(self, loss: float) -> bool:
        """
        Return whether the loss no longer falls, given the mean loss of one more round.

        :param loss: the round's mean loss
        """
        if math.isinf(self.lowest) or loss < self.lowest - self.tolerance * abs(self.lowest):
            self.lowest = loss
            self.rounds_without_improvement = 0
        else:
            self.rounds_without_improvement += 1
        return self.rounds_without_improvement >= self.patience
