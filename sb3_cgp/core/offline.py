"""The convergence rule of a policy's offline training."""

# The paper says "to convergence": the rule and its numbers are this package's choice
ROUND = 1_000  # gradient steps per round
PATIENCE = 5  # rounds in a row without an improvement
TOLERANCE = 0.05  # smallest relative fall of the loss that counts as an improvement


def has_plateaued(losses: list[float]) -> bool:
    """Return whether a loss, by the mean of each round, has not fallen below its lowest in ``PATIENCE`` rounds in a row."""
    lowest, n_without_improvement = losses[0], 0
    for loss in losses[1:]:
        improves = loss < lowest - TOLERANCE * abs(lowest)
        lowest, n_without_improvement = (loss, 0) if improves else (lowest, n_without_improvement + 1)
    return n_without_improvement >= PATIENCE
