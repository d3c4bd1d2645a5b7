"""A task of one step whose reward has maxima of known positions and heights."""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_cgp.common.rules import require, require_count, require_number


class KnownMaxima(gym.Env):
    """
    Reward the only action of an episode by the highest of several bumps at it.

    A bump of height h and width w at position p is ``h * exp(-d^2 / (2 * w^2))``, where d is the root mean square of the
    differences between the action's coordinates and p. So every bump has its maximum on the diagonal of the action space,
    where all coordinates are p, and rewards on the diagonal do not depend on the dimension. By default, a new actor, whose
    actions are close to 0, starts on the slope of a low and wide bump, and the other one is high and narrow.

    :param action_dim: number of action dimensions, A, each within [-1, 1]
    :param positions: the coordinate of each maximum, within [-1, 1]
    :param heights: the reward at each maximum, positive
    :param widths: the width of each bump, positive
    :raises ValueError: if an argument is out of its range, or another bump hides a maximum
    """

    def __init__(
        self,
        action_dim: int = 1,
        positions: Sequence[float] = (-0.4, 0.7),
        heights: Sequence[float] = (0.5, 1.0),
        widths: Sequence[float] = (0.4, 0.15),
    ):
        require_count("action_dim", action_dim)
        require(len(positions) > 0, "positions", positions, "at least one number")
        for position in positions:
            require_number("positions", position, -1.0, 1.0)
        for name, numbers in (("heights", heights), ("widths", widths)):
            require(len(numbers) == len(positions), name, numbers, f"a number for each of {len(positions)} positions")
            for number in numbers:
                require_number(name, number)
                require(number > 0, name, number, "more than 0")
        self.positions, self.heights, self.widths = (np.array(each, float) for each in (positions, heights, widths))
        self._action_dim = action_dim
        self.observation_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (action_dim,), np.float32)
        hidden = self.reward_of(self.maxima) > self.heights
        allowed = "further from each other, or the widths smaller: a higher bump hides a maximum"
        require(not hidden.any(), "positions", positions, allowed)

    @property
    def maxima(self) -> np.ndarray:
        """The actions at the maxima, (M, A), in the order of ``positions``."""
        return np.repeat(self.positions[:, None], self._action_dim, axis=1)

    def reward_of(self, actions: np.ndarray) -> np.ndarray:
        """
        Return the rewards of actions.

        :param actions: the actions, (..., A)
        :return: their rewards, (...)
        """
        differences = np.asarray(actions, dtype=np.float64)[..., None] - self.positions
        squares = np.square(differences).mean(axis=-2)
        return (self.heights * np.exp(-squares / (2 * self.widths**2))).max(axis=-1)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """
        Begin an episode.

        :param seed: seed of the random numbers, of which this task draws none
        :param options: not used
        :return: the only observation, 0, and no info
        """
        super().reset(seed=seed)
        return self._observation(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """
        End the episode by its only action.

        :param action: the action, (A,), which counts as clipped to [-1, 1]
        :return: observation, reward, that the episode has terminated, that it was not truncated, and no info
        """
        return self._observation(), float(self.reward_of(np.clip(action, -1.0, 1.0))), True, False, {}

    def get_training_state(self) -> dict[str, Any]:
        """
        Return the state that a stopped training continues from.

        :return: nothing, as episodes have one step
        """
        return {}

    def set_training_state(self, state: dict[str, Any]) -> None:
        """
        Restore the state of :meth:`get_training_state`.

        :param state: the state
        """

    def _observation(self) -> np.ndarray:
        return np.zeros(1, dtype=np.float32)
