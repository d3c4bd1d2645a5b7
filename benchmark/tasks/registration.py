"""The registration of the tasks in Gymnasium, under ids that rl_zoo3 and sweeps take."""

import dataclasses
from typing import Any

import gymnasium as gym

from benchmark.tasks.zones import AllowedZones

PREFIX = "Restricted"
ORIGINALS = ("Pendulum-v1", "Reacher-v5", "Hopper-v5", "HalfCheetah-v5")

# Action dimensions of the tasks of one step, by their ids
LANDSCAPES = {"KnownMaxima-v0": 1, "KnownMaxima2D-v0": 2, "KnownMaxima3D-v0": 3, "KnownMaxima6D-v0": 6}


def register_tasks() -> None:
    """Register the tasks. The time limits of the original tasks hold, and stay the outermost wrapper."""
    for original in ORIGINALS:
        gym.register(
            id=PREFIX + original,
            entry_point="benchmark.tasks.registration:make_restricted",
            max_episode_steps=gym.spec(original).max_episode_steps,
            kwargs={"original": original},
        )
    for name, action_dim in LANDSCAPES.items():
        gym.register(id=name, entry_point="benchmark.tasks.landscape:KnownMaxima", kwargs={"action_dim": action_dim})


def make_restricted(original: str, levels: int = 3, share: float = 0.5, **kwargs: Any) -> gym.Env:
    """
    Make a task in which actions outside of the allowed zones have no effect, without its time limit.

    :param original: the id of the original task
    :param levels: see :class:`~benchmark.tasks.zones.AllowedZones`
    :param share: see :class:`~benchmark.tasks.zones.AllowedZones`
    :param kwargs: arguments of the original task
    :return: the environment, to which ``gymnasium.make`` adds the time limit and its checks
    :raises ValueError: if ``levels`` or ``share`` is out of its range
    """
    # Without the wrappers that `gymnasium.make` adds to the restricted task itself
    bare = dataclasses.replace(
        gym.spec(original), max_episode_steps=None, order_enforce=False, disable_env_checker=True, additional_wrappers=()
    )
    return AllowedZones(gym.make(bare, **kwargs), levels, share)
