"""
Episodes of a fixed policy, and the discounted return that follows each of their states.

Shapes: T steps of an episode, O observation dimensions, A action dimensions.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import gymnasium as gym
import numpy as np

# The largest share of the return of a counted state that the end of a truncated episode may cut off: γ^H
TAIL = 0.01

# Maps observations (B, O) to actions in the environment's bounds (B, A)
Act = Callable[[np.ndarray], np.ndarray]


@dataclass
class Episode:
    """
    An episode.

    :param observations: the observations by which it acted, T of shape (O,)
    :param actions: the actions, T of shape (A,)
    :param rewards: the rewards, T
    :param is_terminated: whether it has ended by a termination; False for an episode that a time limit truncated
    """

    observations: list[np.ndarray] = field(default_factory=list)
    actions: list[np.ndarray] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    is_terminated: bool = False


def horizon(gamma: float) -> int:
    """
    Return the number of steps after which rewards are discounted to at most ``TAIL``.

    :param gamma: the discount factor, above 0 and below 1
    :return: the number of steps, H
    """
    return math.ceil(math.log(TAIL) / math.log(gamma))


def play(act: Act, envs: Sequence[gym.Env], seed: int) -> list[Episode]:
    """
    Play one episode in each environment, all of them at once, so that the policy acts for a batch.

    :param act: the policy
    :param envs: the environments, each with a time limit
    :param seed: seed of the first environment; that of each further one is larger by one
    :return: the episodes, one for each environment
    """
    episodes = [Episode() for _ in envs]
    observations = [env.reset(seed=seed + number)[0] for number, env in enumerate(envs)]
    running = list(range(len(envs)))
    while running:
        actions = act(np.stack([observations[number] for number in running]))
        for number, action in zip(list(running), actions, strict=True):
            episode = episodes[number]
            episode.observations.append(observations[number])
            episode.actions.append(action)
            observations[number], reward, episode.is_terminated, is_truncated, _ = envs[number].step(action)
            episode.rewards.append(float(reward))
            if episode.is_terminated or is_truncated:
                running.remove(number)
    return episodes


def returns_to_go(rewards: Sequence[float], gamma: float) -> np.ndarray:
    """
    Return the discounted sums of the rewards from each step on.

    :param rewards: the rewards of an episode, T
    :param gamma: the discount factor
    :return: the sums, shape (T,)
    """
    sums = np.zeros(len(rewards) + 1)
    for step in reversed(range(len(rewards))):
        sums[step] = rewards[step] + gamma * sums[step + 1]
    return sums[:-1]


def n_counted(episode: Episode, gamma: float) -> int:
    """
    Return the number of an episode's first states whose return is known.

    :param episode: the episode
    :param gamma: the discount factor
    :return: all T after a termination, which no reward follows; else those that at least H steps follow, see :func:`horizon`
    """
    n_steps = len(episode.rewards)
    return n_steps if episode.is_terminated else max(n_steps - horizon(gamma) + 1, 0)


def error_bounds(episode: Episode, gamma: float) -> np.ndarray:
    """
    Return a bound of the error of each counted state's return, if no reward after the end is larger than the largest in it.

    :param episode: the episode
    :param gamma: the discount factor
    :return: ``γ^k max|r| / (1 - γ)``, where k rewards are known; zeros after a termination
    """
    n_steps = len(episode.rewards)
    if episode.is_terminated:
        return np.zeros(n_steps)
    largest = np.abs(episode.rewards).max() / (1 - gamma)
    return largest * gamma ** (n_steps - np.arange(n_counted(episode, gamma)))
