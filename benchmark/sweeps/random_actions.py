"""Random actions as an algorithm of rl_zoo3, the floor of every comparison."""

from typing import Any

import numpy as np
from gymnasium import spaces
from rl_zoo3 import ALGOS
from stable_baselines3 import TD3

NAME = "random"


class RandomActions(TD3):
    """
    Acts at random and learns nothing, with the interface of SB3's algorithms.

    :param args: TD3's arguments, of which only the environment and the seed are of influence
    :param kwargs: TD3's arguments
    """

    def __init__(self, *args: Any, **kwargs: Any):
        # All steps are random, and no transition is ever sampled
        super().__init__(*args, **{**kwargs, "learning_starts": 2**62, "buffer_size": 1})

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        Draw actions.

        :param observation: one observation, or one of each of several environments
        :param state: of no influence
        :param episode_start: of no influence
        :param deterministic: of no influence
        :return: an action for each, and no recurrent state
        """
        assert isinstance(self.action_space, spaces.Box)
        first = next(iter(observation.values())) if isinstance(observation, dict) else observation
        # SB3's own test for a batch, which knows images with the channels first, too
        _, is_batch = self.policy.obs_to_tensor(observation)
        actions = [self.action_space.sample() for _ in range(len(first) if is_batch else 1)]
        return np.array(actions) if is_batch else actions[0], state


def register_random_actions() -> None:
    """Register random actions with rl_zoo3, as the algorithm ``random``."""
    ALGOS[NAME] = RandomActions
