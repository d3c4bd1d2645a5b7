"""Errors of SB3's that name a symptom, and what they mean: the old API, rewards that are no numbers, early resets."""

import linecache
import re
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

import gymnasium as gym
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_cgp.guards.observation_fit import RETURN_EVERY_KEY

OLD_API = (
    "The environment has the API of Gym before version 0.26. Change it, or wrap it in `shimmy.GymV21CompatibilityV0(env=env)`."
)
OLD_RESET = (
    "The environment's `reset` must take `seed` and `options` and return two values, the observation and a dictionary: "
    f"`def reset(self, *, seed=None, options=None): ...; return observation, info`. {OLD_API}"
)
OLD_STEP = (
    "The environment's `step` must return five values, `observation, reward, terminated, truncated, info`, where `truncated` "
    f"means that the episode ran out of time. {OLD_API}"
)
# The call of an environment, of one of several, of a wrapper's base class, or of a method that replaces another
CALL = re.compile(r"(?:(?<![^\W_])(?:env\w*|super\(\)|self)(?:\[[^]]*\])?\.|return )(step|reset)\(")
OLD_VEC_STEP = (
    "The vectorised environment's `step_wait` must return four values, `observations, rewards, dones, infos`, as SB3's do: "
    "`dones` are ends of any kind, and the info of an episode that ran out of time has `TimeLimit.truncated` True."
)
NO_INFO = "The environment's `{}` must return a dictionary as its last value, `info`; an empty one, `{{}}`, will do."


@contextmanager
def explaining_errors(model: OffPolicyAlgorithm) -> Iterator[None]:
    """
    Raise an error that names the cause and the remedy in place of one that does not, as its cause.

    :param model: the model that learns within the context
    :raises ValueError: in place of SB3's error; other errors pass
    """
    try:
        yield
    except (TypeError, ValueError, RuntimeError, KeyError) as error:
        message = explain(error, model)
        if message is None:
            raise
        raise ValueError(message) from error


@contextmanager
def explaining_early_reset(reason: str) -> Iterator[None]:
    """
    Say why an environment is reset, where a ``Monitor`` admits a reset at the end of an episode only.

    :param reason: why it is reset, in the middle of an episode if need be
    :raises RuntimeError: in place of the ``Monitor``'s
    """
    try:
        yield
    except RuntimeError as error:
        *_, (frame, _) = traceback.walk_tb(error.__traceback__)
        if frame.f_code is not Monitor.reset.__code__:
            raise
        raise RuntimeError(
            f"The environment has to be reset in the middle of an episode: {reason}. Its `Monitor` does not allow that: wrap "
            "it in `Monitor(env, allow_early_resets=True)`, or give a new environment to `set_env`."
        ) from error


def check_reset_info(info: Any) -> None:
    """
    Check the second value of an environment's ``reset``, by which another reset is noticed.

    :param info: the value
    :raises ValueError: if it is no dictionary
    """
    if info is None:
        raise ValueError(NO_INFO.format("reset"))
    if not isinstance(info, dict):
        # A part of an observation, which is all that the old API returns
        raise ValueError(OLD_RESET)


def explain(error: Exception, model: OffPolicyAlgorithm) -> str | None:
    """
    Return what an error means, judged by the function that raised it.

    :param error: the error
    :param model: the model that was learning
    :return: the cause and the remedy; None for an error that speaks for itself
    """
    *_, (frame, line_number) = traceback.walk_tb(error.__traceback__)
    if isinstance(error, KeyError):
        is_observation = frame.f_globals.get("__name__") == SubprocVecEnv.__module__
        missing = f"An environment returned an observation without the key {error} of its space, at environment step"
        return f"{missing} {model.num_timesteps}. It was not stored. {RETURN_EVERY_KEY}" if is_observation else None
    reward = _explain_reward(error, frame)
    if reward is not None:
        return f"The environment returned a reward that is not a number at environment step {model.num_timesteps}{reward}."
    if frame.f_code is HerReplayBuffer.sample.__code__ and isinstance(error, RuntimeError):
        return _explain_no_episode(frame.f_locals["self"], model)
    # Not an error of the environment's own code, but of its callers: SB3, Gymnasium, this package, and wrappers of any package
    is_caller = frame.f_globals.get("__name__", "").startswith(("stable_baselines3.", "gymnasium.", "sb3_cgp.guards."))
    is_wrapper = isinstance(frame.f_locals.get("self"), gym.Wrapper)
    if is_caller or is_wrapper:
        line = linecache.getline(frame.f_code.co_filename, line_number, frame.f_globals)
        return _explain_old_api(str(error), line, is_wrapper)
    return None


def _explain_reward(error: Exception, frame: FrameType) -> str | None:
    """Return the reward that SB3 could not make a number of, if that was the error."""
    if frame.f_code is Monitor.step.__code__ and "reward" in frame.f_locals and "item assignment" not in str(error):
        return f": {frame.f_locals['reward']!r}"
    if frame.f_code is DummyVecEnv.step_wait.__code__ and "array element" in str(error):
        return ""
    return None


def _explain_old_api(error: str, line: str, is_wrapper: bool) -> str | None:
    """Explain an error of unpacking what the environment returned, or of calling it, in a line of code."""
    called = CALL.search(line)
    # A wrapper that expects four values has the old API itself
    if called is not None and "values to unpack (expected 4" in error and not is_wrapper:
        return OLD_VEC_STEP
    if called is not None and ("values to unpack" in error or "cannot unpack" in error):
        return OLD_STEP if called[1] == "step" else OLD_RESET
    if called is not None and re.search(r"reset\(\) (got an unexpected keyword|takes)", error):
        return OLD_RESET
    if "does not support item assignment" in error and "info" in line:
        return NO_INFO.format("step")
    return None


def _explain_no_episode(buffer: HerReplayBuffer, model: OffPolicyAlgorithm) -> str:
    """Explain why a hindsight replay buffer has no whole episode to sample from."""
    cause = (
        f"The HerReplayBuffer holds no whole episode of any of the {buffer.n_envs} environment(s), and samples from whole ones"
    )
    if buffer.full:
        return (
            f"{cause}: its size of {buffer.buffer_size} steps of each environment does not hold a whole episode while another "
            f"one overwrites it. Raise `buffer_size`, which the environments share, to {2 * buffer.n_envs} x the longest "
            "episode or more, or limit the episodes' length (`max_episode_steps`)."
        )
    # The steps of a model that goes on without the replay buffer that it had
    n_before = model.num_timesteps - buffer.pos * buffer.n_envs
    remedy, start = "raise it to", ""
    if n_before > 0:
        remedy = "load the buffer that was saved with the model, `model.load_replay_buffer(path)`, or raise it to"
        start = f"{n_before} + "
    return (
        f"{cause}: it has {buffer.pos} steps of each, and the first episode is longer. `learning_starts` is "
        f"{model.learning_starts} and counts the steps of all environments: {remedy} {start}{buffer.n_envs} x the longest "
        "episode or more."
    )
