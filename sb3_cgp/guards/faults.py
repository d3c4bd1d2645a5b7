"""What CGP does when an environment fails: worker processes that die, observations of a wrong shape or out of bounds."""

import functools
import signal
import threading
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import Pipe, connection
from typing import Any, Concatenate, ParamSpec, TypeVar

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")
SelfAlgorithm = TypeVar("SelfAlgorithm", bound=BaseAlgorithm)

# Seconds for a process to end before it is taken for one that lives on, or is killed
GRACE = 5.0


def guarded(
    learn: Callable[Concatenate[SelfAlgorithm, Parameters], Result],
) -> Callable[Concatenate[SelfAlgorithm, Parameters], Result]:
    """
    Have a training end with an error that says which environment failed, and how.

    While it runs, dead workers of a ``SubprocVecEnv``, the model's or a callback's, become a ``RuntimeError``, and no worker
    is left behind; observations of a wrong shape and rewards that are no number become a ``ValueError``. An
    environment's own exceptions pass.

    :param learn: the method that trains
    :return: the method, guarded
    """

    @functools.wraps(learn)
    def guarded_learn(self: SelfAlgorithm, *args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        env = None if self.env is None else self.env.unwrapped
        with _watching_workers(env) as watch, _checking_shapes(env, self):
            try:
                return learn(self, *args, **kwargs)
            except (EOFError, ConnectionError) as error:
                failed = _subproc_env_in(error)
                if failed is None:
                    raise
                dead = watch.wait() if watch is not None and failed is watch.env else _dead_workers(failed)
                if len(dead) == 0:
                    raise
                message = _describe_dead(failed, dead, self.num_timesteps)
                end_workers(failed)
                raise RuntimeError(message) from error
            except (TypeError, ValueError) as error:
                reward = _describe_reward(error, self.num_timesteps)
                if reward is None:
                    raise
                raise ValueError(reward) from error

    return guarded_learn


def end_workers(env: SubprocVecEnv) -> None:
    """
    End every worker, whatever it is doing, and close the environment.

    :param env: the environment, whose ``close`` does nothing from now on
    """
    _end_processes(env)
    for remote in env.remotes:
        remote.close()
    env.waiting, env.closed = False, True


def _end_processes(env: SubprocVecEnv) -> None:
    for process in env.processes:
        process.terminate()
    for process in env.processes:
        process.join(GRACE)
        # A process that was forked after pygame had begun takes SIGTERM for an event
        if process.is_alive():
            process.kill()
            process.join()


class BoundsWatch:
    """
    Warns of the first observation that is outside of its space. Nothing of CGP's depends on the bounds.

    :param space: the observation space
    """

    def __init__(self, space: spaces.Space):
        subspaces = space.spaces if isinstance(space, spaces.Dict) else {None: space}
        # Integers, such as images, cannot leave the bounds of their type
        self._boxes = {
            key: box
            for key, box in subspaces.items()
            if isinstance(box, spaces.Box)
            and np.issubdtype(box.dtype, np.floating)
            and (box.bounded_below.any() or box.bounded_above.any())
        }

    def check(self, observation: VecEnvObs, timestep: int) -> None:
        """
        Warn if an observation is out of bounds, unless it has happened before.

        :param observation: the observations of all environments, or of one
        :param timestep: the environment step
        """
        for key, box in self._boxes.items():
            values = observation if key is None else observation[key]  # type: ignore[call-overload]
            outside = (values < box.low) | (values > box.high)
            if outside.any():
                self._warn(key, box, np.asarray(values), outside, timestep)
                self._boxes = {}
                return

    @staticmethod
    def _warn(key: str | None, box: spaces.Box, values: np.ndarray, outside: np.ndarray, timestep: int) -> None:
        first = tuple(np.argwhere(outside)[0].tolist())
        # Observations of several environments have an axis more
        index = first[values.ndim - len(box.shape) :]
        name = "observation" if key is None else f"observation `{key}`"
        warnings.warn(
            f"The environment returned an {name} outside of its observation space at environment step {timestep}: value "
            f"{values[first]} at index {index}, where the bounds are [{box.low[index]}, {box.high[index]}]. Training goes on, "
            "as nothing in CGP depends on these bounds. This is said once.",
            stacklevel=2,
        )


def check_shape(name: str, values: Any, space: spaces.Space, n_envs: int | None, timestep: int) -> None:
    """
    Refuse observations of another shape than their space's, which NumPy may stretch to it.

    :param name: what the values are
    :param values: the observations of all environments, or of one
    :param space: the observation space
    :param n_envs: number of environments; None for the observation of one
    :param timestep: the environment step
    :raises ValueError: naming the shape and the one that is expected
    """
    batch = () if n_envs is None else (n_envs,)
    for key, subspace in space.spaces.items() if isinstance(space, spaces.Dict) else [(None, space)]:
        shape, expected = np.shape(values if key is None else values[key]), (*batch, *(subspace.shape or ()))
        # NumPy may drop leading axes of length 1, or add them: no number is lost or repeated
        if shape != expected and _without_leading_ones(shape) != _without_leading_ones(expected):
            raise _wrong_shape(name if key is None else f"{name} `{key}`", shape, expected, timestep)


def check_reward(rewards: Any, n_envs: int, timestep: int) -> None:
    """
    Refuse rewards that are not one number for each environment.

    :param rewards: what the environments returned
    :param n_envs: number of environments
    :param timestep: the environment step
    :raises ValueError: naming the shape and the one that is expected, or the values
    """
    if np.shape(rewards) != (n_envs,):
        raise _wrong_shape("reward", np.shape(rewards), (n_envs,), timestep)
    if np.asarray(rewards).dtype.kind not in "biuf":
        raise ValueError(f"The environment returned a reward that is not a number at environment step {timestep}: {rewards}.")


def _wrong_shape(name: str, shape: tuple[int, ...], expected: tuple[int, ...], timestep: int) -> ValueError:
    message = f"The environment returned an array of a wrong shape at environment step {timestep}"
    return ValueError(f"{message}: the {name} has shape {shape}, where {expected} is expected. It was not stored.")


def _without_leading_ones(shape: tuple[int, ...]) -> tuple[int, ...]:
    n_ones = next((index for index, length in enumerate(shape) if length != 1), len(shape))
    return shape[n_ones:]


@contextmanager
def _checking_shapes(env: VecEnv | None, model: BaseAlgorithm) -> Iterator[None]:
    """
    Have a ``DummyVecEnv`` refuse observations that NumPy would stretch to the shape of its buffer.

    Nothing outside of it sees them as they were, so that a private method is shadowed for the time.
    """
    if not isinstance(env, DummyVecEnv):
        yield
        return
    save = env._save_obs

    def save_checked(env_idx: int, obs: Any) -> None:
        check_shape("observation", obs, env.observation_space, None, model.num_timesteps)
        save(env_idx, obs)

    env._save_obs = save_checked  # type: ignore[method-assign]
    try:
        yield
    finally:
        del env._save_obs


class _WorkerWatch:
    """
    Waits for the first death among the workers of a ``SubprocVecEnv``, and ends the others.

    A main process that reads from a dead worker's pipe waits for ever if another worker has inherited its end, as happens
    with the start method "fork". When all of them are dead, it does not.

    :param env: the environment
    """

    def __init__(self, env: SubprocVecEnv):
        self.env = env
        self.dead: list[int] = []
        self._stop_receiver, self._stop_sender = Pipe(duplex=False)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        ready = connection.wait([self._stop_receiver, *(process.sentinel for process in self.env.processes)])
        if self._stop_receiver not in ready:
            self.dead = _dead_workers(self.env)
            _end_processes(self.env)

    def wait(self, timeout: float = GRACE) -> list[int]:
        """
        Give workers the time to die.

        :param timeout: how long, in seconds
        :return: the indices of those that have died by themselves
        """
        self._thread.join(timeout)
        return self.dead

    def stop(self) -> None:
        """Stop waiting."""
        self._stop_sender.send(None)
        self._thread.join()
        self._stop_sender.close()
        self._stop_receiver.close()


@contextmanager
def _watching_workers(env: VecEnv | None) -> Iterator[_WorkerWatch | None]:
    """Watch an environment's workers, if it has any, and close it when one has died, however the training ends."""
    if not isinstance(env, SubprocVecEnv) or env.closed:
        yield None
        return
    watch = _WorkerWatch(env)
    try:
        yield watch
    except KeyboardInterrupt:
        # A terminal sends it to the workers too, which end by it, on a busy machine not at once
        watch.wait(timeout=2.0)
        raise
    finally:
        watch.stop()
        if len(watch.dead) > 0 and not env.closed:
            end_workers(env)


def _dead_workers(env: SubprocVecEnv) -> list[int]:
    """List the workers that have died, having given them the time to; their exit codes are known then."""
    ready = connection.wait([process.sentinel for process in env.processes], GRACE)
    for process in env.processes:
        if process.sentinel in ready:
            process.join(GRACE)
    return [index for index, process in enumerate(env.processes) if process.sentinel in ready]


def _subproc_env_in(error: BaseException) -> SubprocVecEnv | None:
    """Find the environment in which an error was raised: the training's, or a callback's."""
    environments = [frame.f_locals.get("self") for frame, _ in traceback.walk_tb(error.__traceback__)]
    return next((env for env in reversed(environments) if isinstance(env, SubprocVecEnv)), None)


def _describe_dead(env: SubprocVecEnv, dead: list[int], timestep: int) -> str:
    ends = []
    for index in dead:
        process = env.processes[index]
        code = process.exitcode
        if code is not None and code < 0:
            how = f"was killed by signal {-code} ({signal.strsignal(-code)})"
        else:
            how = f"ended with exit code {code}"
        ends.append(f"worker {index} (process {process.pid}) {how}")
    return (
        f"An environment's process died at environment step {timestep}: of {len(env.processes)} workers, {', '.join(ends)}. "
        "An exception in it is printed above; a signal 9 is often for lack of memory. The other workers were ended too, and "
        "the environment is closed."
    )


def _describe_reward(error: Exception, timestep: int) -> str | None:
    """Say what was wrong with a reward, if it is what SB3 stumbled over."""
    *_, (frame, _) = traceback.walk_tb(error.__traceback__)
    if frame.f_code is Monitor.step.__code__ and "reward" in frame.f_locals:
        reward = f": {frame.f_locals['reward']!r}"
    elif frame.f_code is DummyVecEnv.step_wait.__code__ and "array element" in str(error):
        reward = ""
    else:
        return None
    return f"The environment returned a reward that is not a number at environment step {timestep}{reward}."
