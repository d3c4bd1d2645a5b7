"""The offline training of a policy: when it has converged, and what callbacks see of it."""

import math
import warnings
from collections.abc import Callable

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, tqdm

from sb3_cgp.common.rules import require_count, require_number

# Gradient steps between two looks at the loss
ROUND = 1_000


class Plateau:
    """
    Tells when a loss has ceased to fall.

    The rule: ``patience`` rounds in a row, none of whose losses lies below the lowest loss before them by more than
    ``tolerance`` times the latter's magnitude.

    :param patience: number of rounds without an improvement, at least 1
    :param tolerance: smallest relative fall of the loss that counts as an improvement
    :raises ValueError: if an argument is out of its range
    """

    def __init__(self, patience: int = 5, tolerance: float = 0.05):
        require_count("patience", patience)
        require_number("tolerance", tolerance)
        self.patience = patience
        self.tolerance = tolerance
        self.lowest = math.inf
        self.rounds_without_improvement = 0

    def reached(self, loss: float) -> bool:
        """
        Take in the loss of one more round.

        :param loss: the round's mean loss
        :return: whether the loss has ceased to fall
        """
        if math.isinf(self.lowest) or loss < self.lowest - self.tolerance * abs(self.lowest):
            self.lowest = loss
            self.rounds_without_improvement = 0
        else:
            self.rounds_without_improvement += 1
        return self.rounds_without_improvement >= self.patience


def descend_to_plateau(
    step: Callable[[int], float],
    after_round: Callable[[int, float], None],
    callback: BaseCallback,
    max_steps: int,
    n_envs: int,
    progress_bar: bool = False,
) -> tuple[int, bool]:
    """
    Repeat a gradient step until its loss, averaged over rounds of 1,000 steps, reaches a plateau.

    Callbacks see each step as one in which no environment moved: no reward, no end of an episode.

    :param step: takes the gradient step of the given number, from 1, and returns its loss
    :param after_round: takes the number of steps so far and the round's mean loss
    :param callback: is called at every step, and stops by returning False
    :param max_steps: largest number of steps; a warning says if they did not suffice
    :param n_envs: number of environments, for the callbacks
    :param progress_bar: whether to display a progress bar
    :return: the number of steps, and whether they were enough for a policy: a round, or all that were asked for
    """
    standstill = dict(rewards=np.zeros(n_envs), dones=np.zeros(n_envs, dtype=bool), infos=[{} for _ in range(n_envs)])
    total_timesteps = callback.model.num_timesteps + max_steps * n_envs
    callback.on_training_start({"self": callback.model, "total_timesteps": total_timesteps, **standstill}, globals())
    plateau, losses = Plateau(), []
    for n_steps in tqdm(range(1, max_steps + 1), disable=not progress_bar):
        losses.append(step(n_steps))
        callback.update_locals(standstill)
        if not callback.on_step():
            break
        if n_steps % ROUND == 0:
            loss, losses = float(np.mean(losses)), []
            after_round(n_steps, loss)
            if plateau.reached(loss):
                break
    else:
        # Told to whoever called `train_policy` or `learn`
        warnings.warn(f"The policy's loss had not reached a plateau after max_steps={max_steps} gradient steps.", stacklevel=3)
    callback.on_training_end()
    return n_steps, n_steps >= min(ROUND, max_steps)
