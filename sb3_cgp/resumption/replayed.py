"""Restoring an environment whose simulator's state cannot be read or set, such as Box2D's: by replaying its episode."""

import pickle
import warnings
from copy import deepcopy
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_cgp.common.rules import require
from sb3_cgp.resumption.declarations import full_name
from sb3_cgp.resumption.plain_data import NotPlainError, equal, set_plain_attributes, to_plain


class ReplayedEnv(gym.Wrapper):
    """
    Record what an episode depends on, and restore the environment by repeating the episode up to the saved step.

    The environment must be deterministic: after a reset, the same state of ``np_random`` and the same actions must lead to the
    same observations, whatever was before the reset. Gymnasium's Box2D tasks are. Restoring takes as long as the steps of the
    episode so far.

    :param env: the environment itself, without wrappers; for one with wrappers use :func:`replayed`
    :raises ValueError: if the environment has wrappers
    """

    def __init__(self, env: gym.Env):
        super().__init__(env)
        require(not isinstance(env, gym.Wrapper), "env", env, "an environment without wrappers: use `replayed(env)`")
        # The random generator before the reset, the reset's arguments, the actions since, the random generators before the
        # steps before which a wrapper has drawn from it, and the last observation
        self._episode: dict[str, Any] | None = None
        # The state of the random generator after the last step
        self._drawn = b""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """
        Reset the environment, and begin a new record.

        :param seed: the seed
        :param options: the options
        :return: the observation, and the infos
        """
        random = deepcopy(self._generator())
        _make_new_world(self.env)
        observation, infos = self.env.reset(seed=seed, options=options)
        arguments = {"seed": seed, "options": options}
        self._episode = {"random": random, "arguments": arguments, "actions": [], "drawn": {}, "observation": observation}
        self._drawn = self._random_state()
        return observation, infos

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """
        Take a step in the environment, and record its action.

        :param action: the action
        :return: the observation, the reward, whether the episode has terminated, whether it was truncated, and the infos
        """
        # A copy, as the environment or the caller may change the array
        recorded = np.array(action)
        if self._episode is not None and self._random_state() != self._drawn:
            # A wrapper has drawn from the generator, which it shares
            self._episode["drawn"][len(self._episode["actions"])] = deepcopy(self._generator())
        result = self.env.step(action)
        if self._episode is not None:
            self._episode["actions"].append(recorded)
            self._episode["observation"] = result[0]
            self._drawn = self._random_state()
        return result

    def _generator(self) -> Any:
        """Return the environment's random generator, or None if there is none: the property would create one."""
        return vars(self.env).get("_np_random")

    def _random_state(self) -> bytes:
        """Return what tells whether numbers were drawn from the environment's random generator."""
        generator = self._generator()
        return pickle.dumps(generator.bit_generator.state) if isinstance(generator, np.random.Generator) else b""

    def _set_generator(self, generator: Any) -> None:
        """Set the state of the environment's random generator, in place if there is one, as wrappers share it."""
        if generator is not None:
            set_plain_attributes(self.env, {"_np_random": to_plain(generator)})

    def get_training_state(self) -> Any:
        """
        Return the record of the episode.

        :return: what can be converted to plain data; None if the reset's options or the observations cannot
        """
        try:
            to_plain(self._episode)
        except NotPlainError:
            return None
        return {"episode": self._episode}

    def set_training_state(self, state: dict[str, Any]) -> None:
        """
        Repeat a recorded episode up to its last step, and warn if that does not lead to the same observation.

        :param state: the record that :meth:`get_training_state` returned
        """
        episode = state["episode"]
        self._episode = None
        if episode is None:
            return
        self._set_generator(episode["random"])
        self.reset(**episode["arguments"])
        for index, action in enumerate(episode["actions"]):
            self._set_generator(episode["drawn"].get(index))
            self.step(action)
        assert self._episode is not None
        if not equal(to_plain(self._episode["observation"]), to_plain(episode["observation"])):
            warnings.warn(
                f"The episode of {self.env} that was repeated led to another observation than the saved one: the environment "
                "depends on more than its actions and `np_random` since its reset. The training goes on, and is not the same.",
                stacklevel=2,
            )


def replayed(env: gym.Env) -> gym.Env:
    """
    Put a :class:`ReplayedEnv` around the innermost environment, within its wrappers.

    To be used as ``wrapper_class`` of ``make_vec_env``, or as ``env_wrapper`` in rl_zoo3.

    :param env: the environment, which is changed if it has wrappers
    :return: the environment
    """
    if not isinstance(env, gym.Wrapper):
        return ReplayedEnv(env)
    innermost = env
    while isinstance(innermost.env, gym.Wrapper):
        innermost = innermost.env
    if not isinstance(innermost, ReplayedEnv):
        innermost.env = ReplayedEnv(innermost.env)
    return env


def _make_new_world(env: gym.Env) -> None:
    """Give Gymnasium's BipedalWalker a new world, as its LunarLander has in each episode: an old one keeps its contacts."""
    name = "gymnasium.envs.box2d.bipedal_walker.BipedalWalker"
    # By its name, as importing Box2D takes long
    if any(full_name(base) == name for base in type(env).__mro__):
        walker: Any = env
        # Removes what is in the old world, which the environment's `reset` could not remove from the new one
        walker._destroy()
        walker.world = type(walker.world)()
