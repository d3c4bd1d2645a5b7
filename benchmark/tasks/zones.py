"""Actions that act within allowed zones only, as on a machine with forbidden zones of operation."""

from functools import cache
from numbers import Real
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from scipy.stats.qmc import Sobol

from sb3_cgp.common.rules import require, require_count

# Points of Sobol's sequence, as a power of two; the allowed share is exact to about 1e-3
LOG_POINTS = 16


class AllowedZones(gym.Wrapper, RecordConstructorArgs):
    """
    Let only those actions act that lie within balls around a grid; any other action acts as the neutral action does.

    The rule is that of the action space scaled to [-1, 1]^A. The balls are centred at all points whose coordinates are
    among ``levels`` equally spaced numbers from -1 to 1: with three levels, each actuator at full power in either direction
    or at rest, in all combinations. All balls have the same Euclidean radius, with which they cover ``share`` of the action
    space. The neutral action is the centre of the action space, on the original tasks no torque.

    So the value of a state is a constant on the forbidden actions, and has a maximum of its own in most balls. All bang-bang
    behaviour of the original task stays possible.

    ``info["allowed"]`` says of each step whether the action acted.

    :param env: the environment, with a bounded ``Box`` of floats as its action space
    :param levels: number of grid points per action dimension, at least 2
    :param share: share of the action space that is allowed, between 0 and 1 and neither of them
    :raises ValueError: if the action space is of another kind, or an argument is out of its range
    """

    def __init__(self, env: gym.Env, levels: int = 3, share: float = 0.5):
        RecordConstructorArgs.__init__(self, levels=levels, share=share)
        gym.Wrapper.__init__(self, env)
        space = env.action_space
        is_box = isinstance(space, spaces.Box) and np.issubdtype(space.dtype, np.floating) and space.is_bounded()
        allowed = "a Box of floats with finite bounds that differ"
        require(is_box, "env.action_space", space, allowed)
        assert isinstance(space, spaces.Box)
        require(bool((space.low < space.high).all()), "env.action_space", space, allowed)
        require_count("levels", levels, minimum=2)
        is_number = isinstance(share, Real) and not isinstance(share, bool)
        require(is_number and 0 < share < 1, "share", share, "a number between 0 and 1, and neither of them")
        self.spacing = 2.0 / (levels - 1)
        self.radius = self.spacing * unit_radius(int(np.prod(space.shape)), float(share))
        low, high = (bound.astype(np.float64) for bound in (space.low, space.high))
        self._middle, self._half_width = (low + high) / 2, (high - low) / 2
        self.neutral_action = self._middle.astype(space.dtype)

    def step(self, action: np.ndarray) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """
        Take a step by the action if it is allowed, and by the neutral action if not.

        :param action: the action, within the bounds of the action space
        :return: what the environment returns, with ``allowed`` in the info
        """
        allowed = self.is_allowed(action)
        observation, reward, terminated, truncated, info = self.env.step(action if allowed else self.neutral_action)
        return observation, reward, terminated, truncated, {**info, "allowed": allowed}

    def is_allowed(self, action: np.ndarray) -> bool:
        """
        Return whether an action lies within a ball.

        :param action: the action, in the units of the environment; it counts as clipped to the bounds
        :return: whether it is allowed; an action with NaN is, so that the environment deals with it as without this wrapper
        """
        scaled = ((np.asarray(action, dtype=np.float64) - self._middle) / self._half_width).clip(-1, 1)
        nearest = np.rint((scaled + 1) / self.spacing) * self.spacing - 1
        return not bool(np.linalg.norm(scaled - nearest) > self.radius)

    def get_training_state(self) -> dict[str, Any]:
        """
        Return the state that a stopped training continues from.

        :return: nothing, as the zones do not change
        """
        return {}

    def set_training_state(self, state: dict[str, Any]) -> None:
        """
        Restore the state of :meth:`get_training_state`.

        :param state: the state
        """


@cache
def unit_radius(dimension: int, share: float) -> float:
    """
    Return the radius with which balls around all points of the integer grid cover a share of the space.

    That is the quantile of the distance of a uniformly distributed point to its nearest grid point. The same share of the
    action space is covered, as the balls at its boundary count with the part inside.

    :param dimension: number of dimensions, A
    :param share: the covered share
    :return: the radius
    """
    offsets = Sobol(dimension, scramble=False).random_base2(LOG_POINTS) - 0.5
    return float(np.quantile(np.linalg.norm(offsets, axis=1), share))
