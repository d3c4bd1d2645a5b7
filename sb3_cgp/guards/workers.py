"""Worker processes of a ``SubprocVecEnv`` that die while a model learns."""

import signal
import threading
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import Pipe, connection

from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv

from sb3_cgp.guards.observations import innermost

# Seconds that a process is given to end before it is killed, or is taken to be alive
GRACE = 5.0


@contextmanager
def watching_workers(model: OffPolicyAlgorithm) -> Iterator[None]:
    """
    Turn the death of a worker process into an error that names the worker, and leave no worker process behind.

    Watched are the workers of the training environment. A dead worker of a callback's environment is named as well.

    :param model: the model that learns within the context
    :raises RuntimeError: if a worker of a ``SubprocVecEnv`` has died; its environment is closed
    """
    with _watch_of(innermost(model.env)) as watch:
        try:
            yield
        except (EOFError, ConnectionError) as error:
            failed = _subproc_env_in(error)
            if failed is None:
                raise
            dead = watch.wait() if watch is not None and failed is watch.env else _dead_workers(failed)
            if len(dead) == 0:
                raise
            message = _describe_dead(failed, dead, model.num_timesteps)
            end_workers(failed)
            raise RuntimeError(message) from error


def discard_replies(env: VecEnv | None) -> None:
    """
    Discard the replies that an interrupted step or reset has left unread, which would be taken for those of the next one.

    :param env: the environment, of which an open ``SubprocVecEnv`` alone has replies
    """
    env = innermost(env)
    if not isinstance(env, SubprocVecEnv) or env.closed:
        return
    is_interrupted = False
    for remote in env.remotes:
        # A worker answers in order, and this request alone by True or False
        remote.send(("has_attr", "unwrapped"))
        while not isinstance(remote.recv(), bool):
            is_interrupted = True
    env.waiting = False
    if is_interrupted:
        # As after any other step or reset, which EpisodeGuard compares
        env.reset_infos = list(env.reset_infos)


def end_workers(env: SubprocVecEnv) -> None:
    """
    End every worker, including workers that are busy, and close the environment.

    :param env: the environment, whose ``close`` has no effect from now on
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
        # A process that was forked after pygame had started takes SIGTERM for an event
        if process.is_alive():
            process.kill()
            process.join()


class _WorkerWatch:
    """
    Wait for the first death among the workers of a ``SubprocVecEnv``, and end the other workers.

    A main process that reads from a dead worker's pipe waits for ever if another worker has inherited the pipe's end, as
    happens with the start method "fork". It does not wait when all of them are dead.

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
        Wait until the death of a worker has been dealt with.

        :param timeout: the longest time to wait, in seconds
        :return: the indices of the workers that have died by themselves
        """
        self._thread.join(timeout)
        return self.dead

    def stop(self) -> None:
        """Stop watching."""
        self._stop_sender.send(None)
        self._thread.join()
        self._stop_sender.close()
        self._stop_receiver.close()


# The watches of the trainings in progress: a nested training on the same environment uses the outer one's
_watches: list[_WorkerWatch] = []


@contextmanager
def _watch_of(env: VecEnv | None) -> Iterator[_WorkerWatch | None]:
    """Watch an environment's workers, if it has any. When one has died, close the environment, however the training ends."""
    outer = next((watch for watch in _watches if watch.env is env), None)
    if outer is not None or not isinstance(env, SubprocVecEnv) or env.closed:
        yield outer
        return
    watch = _WorkerWatch(env)
    _watches.append(watch)
    try:
        yield watch
    except KeyboardInterrupt:
        # A terminal sends it to the workers too, which end by it, on a busy machine not at once
        watch.wait(timeout=2.0)
        raise
    finally:
        _watches.remove(watch)
        watch.stop()
        if len(watch.dead) > 0 and not env.closed:
            end_workers(env)


def _dead_workers(env: SubprocVecEnv) -> list[int]:
    """List the workers that have died, after a time to die. Their exit codes are known then."""
    ready = connection.wait([process.sentinel for process in env.processes], GRACE)
    for process in env.processes:
        if process.sentinel in ready:
            process.join(GRACE)
    return [index for index, process in enumerate(env.processes) if process.sentinel in ready]


def _subproc_env_in(error: BaseException) -> SubprocVecEnv | None:
    """Return the environment in which an error was raised: the training's, or a callback's."""
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
