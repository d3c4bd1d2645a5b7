"""Environments of a population: a few processes, each of which steps several environments."""

import multiprocessing as mp
from collections.abc import Callable, Sequence
from multiprocessing.connection import wait
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv
from stable_baselines3.common.vec_env.base_vec_env import CloudpickleWrapper, VecEnvIndices, VecEnvObs, VecEnvStepReturn

from sb3_cgp.common.rules import require
from sb3_cgp.guards.workers import GRACE, end_workers
from sb3_cgp.population.environment_worker import step_chunk
from sb3_cgp.population.processes import choose_processes, chunk_bounds


class ChunkedSubprocVecEnv(SubprocVecEnv):
    """
    Environments in a few processes, each of which steps several of them one after the other, by a ``DummyVecEnv``.

    SB3's ``SubprocVecEnv`` has one process for each environment: with more of them than cores, most of a step is spent in
    switching between processes and in one message for each environment. This one sends a message for each process. What it
    returns is identical to what a ``DummyVecEnv`` of the same environments returns, but observations that NumPy would round or
    broadcast to their space end the process with an error. It is a ``SubprocVecEnv``, so that dead processes and saved states
    are handled as for any other.

    :param env_fns: functions that make the environments
    :param n_processes: number of processes, at most as many as environments; None for one for each available core
    :param start_method: "forkserver", "spawn" or "fork", see SB3's ``SubprocVecEnv``
    :raises ValueError: if there is no function, the number of processes is out of its range, or there is no such start method
    :raises RuntimeError: if a process ends before it has made its environments
    """

    def __init__(
        self, env_fns: Sequence[Callable[[], gym.Env]], n_processes: int | None = None, start_method: str | None = None
    ):
        # Not SubprocVecEnv's constructor, which starts a process for each environment
        n_envs = len(env_fns)
        require(n_envs > 0, "env_fns", env_fns, "a sequence of at least one function")
        self._bounds = chunk_bounds(n_envs, choose_processes(n_processes, n_envs, start_method))
        self.waiting = self.closed = False
        # SB3's choice
        start_method = start_method or ("forkserver" if "forkserver" in mp.get_all_start_methods() else "spawn")
        context: Any = mp.get_context(start_method)
        self.remotes, self.work_remotes = zip(*[context.Pipe() for _ in self._bounds], strict=True)
        self.processes = []
        for (start, stop), remote, work_remote in zip(self._bounds, self.remotes, self.work_remotes, strict=True):
            arguments = (work_remote, remote, CloudpickleWrapper(list(env_fns[start:stop])))
            # A daemon ends with the main process
            process = context.Process(target=step_chunk, args=arguments, daemon=True)
            process.start()
            self.processes.append(process)
            work_remote.close()
        VecEnv.__init__(self, n_envs, *self._receive_spaces())

    def _receive_spaces(self) -> tuple[gym.Space, gym.Space]:
        """
        Wait until all processes have made their environments.

        :return: observation and action space
        :raises RuntimeError: if a process has ended before; the others are ended too
        """
        spaces = []
        for index, (remote, process) in enumerate(zip(self.remotes, self.processes, strict=True)):
            try:
                remote.send(("get_spaces", None))
                # A forked process inherits the others' ends of pipes, so that the end of a pipe does not tell of every death
                if remote not in wait([remote, process.sentinel]):
                    raise EOFError
                spaces.append(remote.recv())
            except (EOFError, ConnectionError) as error:
                process.join(GRACE)
                code = process.exitcode
                end_workers(self)
                start, stop = self._bounds[index]
                raise RuntimeError(
                    f"Process {index} of {len(self.processes)} ended with exit code {code} before it had made its "
                    f"environments, with the indices {start} to {stop - 1}. Its own error is printed above; "
                    "`make_population_env` with `n_processes=1` makes them in this process and raises that error. "
                    "The other processes were ended too."
                ) from error
        return spaces[0]

    def step_async(self, actions: np.ndarray) -> None:
        """
        Tell the environments to take a step.

        :param actions: an action of each environment
        """
        for (start, stop), remote in zip(self._bounds, self.remotes, strict=True):
            remote.send(("step", actions[start:stop]))
        self.waiting = True

    def step_wait(self) -> VecEnvStepReturn:
        """
        Wait for the step.

        :return: observations, rewards, ends of episodes and infos
        """
        observations, rewards, dones, infos, reset_infos = zip(*[remote.recv() for remote in self.remotes], strict=True)
        self.waiting = False
        self.reset_infos = _join(reset_infos)
        return _concatenate(observations), np.concatenate(rewards), np.concatenate(dones), _join(infos)

    def reset(self) -> VecEnvObs:
        """
        Reset the environments.

        :return: observations
        """
        for (start, stop), remote in zip(self._bounds, self.remotes, strict=True):
            remote.send(("reset", (self._seeds[start:stop], self._options[start:stop])))
        observations, reset_infos = zip(*[remote.recv() for remote in self.remotes], strict=True)
        self.reset_infos = _join(reset_infos)
        self._reset_seeds()
        self._reset_options()
        return _concatenate(observations)

    def get_images(self) -> Sequence[np.ndarray | None]:
        """
        Return an image of each environment.

        :return: the images
        """
        for remote in self.remotes:
            remote.send(("render", None))
        return _join([remote.recv() for remote in self.remotes])

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """
        Return an attribute of each environment.

        :param attr_name: the attribute's name
        :param indices: the environments; None for all
        :return: its values
        """
        return self._ask("get_attr", indices, attr_name)

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """
        Set an attribute of each environment.

        :param attr_name: the attribute's name
        :param value: its value
        :param indices: the environments; None for all
        """
        self._ask("set_attr", indices, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """
        Call a method of each environment.

        :param method_name: the method's name
        :param method_args: its arguments
        :param indices: the environments; None for all
        :param method_kwargs: its keyword arguments
        :return: its results
        """
        return self._ask("env_method", indices, method_name, *method_args, **method_kwargs)

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """
        Return whether each environment has a wrapper.

        :param wrapper_class: the wrapper
        :param indices: the environments; None for all
        :return: whether it has
        """
        return self._ask("env_is_wrapped", indices, wrapper_class)

    def _positions(self, indices: VecEnvIndices) -> list[int]:
        """
        Return the positions of some of the environments, counted from the first one.

        :param indices: the environments, negative indices from the last one; None for all
        :return: the positions
        :raises IndexError: if an index is out of range, as in a ``DummyVecEnv``
        """
        try:
            return [range(self.num_envs)[index] for index in self._get_indices(indices)]
        except IndexError as error:
            allowed = f"indices of the {self.num_envs} environments, from {-self.num_envs} to {self.num_envs - 1}"
            raise IndexError(f"The value of `indices` is {indices!r}, but must be {allowed}.") from error

    def _get_target_remotes(self, indices: VecEnvIndices) -> list[Any]:
        """Return the connections of the processes that some of the environments are in, for SB3's ``has_attr``."""
        wanted = set(self._positions(indices))
        pairs = zip(self._bounds, self.remotes, strict=True)
        return [remote for (start, stop), remote in pairs if not wanted.isdisjoint(range(start, stop))]

    def _ask(self, method: str, indices: VecEnvIndices, *args: Any, **kwargs: Any) -> list[Any]:
        """Call a method of each process's ``DummyVecEnv`` for some of the environments, and return a value of each."""
        answers: dict[int, Any] = {}
        wanted = self._positions(indices)
        asked = []
        for (start, stop), remote in zip(self._bounds, self.remotes, strict=True):
            own = [index for index in dict.fromkeys(wanted) if start <= index < stop]
            if own:
                remote.send(("call", (method, args, kwargs | {"indices": [index - start for index in own]})))
                asked.append((remote, own))
        for remote, own in asked:
            values = remote.recv()
            answers.update(zip(own, [None] * len(own) if values is None else values, strict=True))
        return [answers[index] for index in wanted]

    def get_training_state(self) -> dict[str, Any]:
        """
        Return what this object has to remember beside the states of the environments.

        :return: the seeds and options of the next reset
        """
        return {"seeds": list(self._seeds), "options": list(self._options)}

    def set_training_state(self, state: dict[str, Any]) -> None:
        """
        Restore what :meth:`get_training_state` returned.

        :param state: the state
        """
        self._seeds, self._options = state["seeds"], state["options"]


def _concatenate(observations: Sequence[Any]) -> Any:
    """Join the observations of all processes: arrays, or arrays by key, or tuples of arrays."""
    first = observations[0]
    if isinstance(first, dict):
        return {key: np.concatenate([each[key] for each in observations]) for key in first}
    if isinstance(first, tuple):
        return tuple(np.concatenate(parts) for parts in zip(*observations, strict=True))
    return np.concatenate(observations)


def _join(lists: Sequence[Sequence[Any]]) -> list[Any]:
    return [each for part in lists for each in part]
