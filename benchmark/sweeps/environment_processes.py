"""Environments in other processes: how they are closed, and what the death of a process means for the runs."""

import signal
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import connection
from pathlib import Path

from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv

from benchmark.sweeps.signals import TERMINATED
from sb3_cgp.guards.workers import GRACE, discard_replies, end_workers

# Signals that end a process for an error in its own program
PROGRAM_ERRORS = (signal.SIGABRT, signal.SIGFPE, signal.SIGILL, signal.SIGSEGV)
# The exit codes after SIGTERM, which a scheduler sends to all processes of a job. The second one is multiprocessing's, where
# the server that had forked the process has ended, too.
STOPPED = (-signal.SIGTERM, 255)


def close_environments(env: VecEnv) -> None:
    """
    Close environments, also when one of their processes has died, which SB3's ``close`` answers with an error of a pipe.

    :param env: the environments
    """
    if not isinstance(env, SubprocVecEnv):
        env.close()
    elif not env.closed:
        try:
            if not all(process.is_alive() for process in env.processes):
                raise EOFError
            if env.waiting:
                # An interrupted step may have read some of the replies that `close` would wait for
                discard_replies(env)
            env.close()
        except (EOFError, ConnectionError):
            end_workers(env)


@contextmanager
def classified_deaths(population: Path) -> Iterator[None]:
    """
    Turn the death of an environment's process into an error that tells whether the runs are to blame.

    :param population: the folder of the population, for the error's message
    :return: a context, in which the environments are used and not yet closed
    :raises SystemExit: if SIGTERM has ended the processes
    :raises ChildProcessError: if another signal from outside has ended a process, as for lack of memory
    :raises RuntimeError: if a process has ended for an error in its own program
    """
    try:
        yield
    except Exception as error:
        codes = _exit_codes(error)
        if not codes:
            raise
        own = [code for code in codes if code not in STOPPED and (code >= 0 or -code in PROGRAM_ERRORS)]
        # The guard of `learn` ends the other processes by SIGTERM
        cause = next((code for code in [*own, *codes] if code not in STOPPED), -signal.SIGTERM)
        message = f"An environment's process {_in_words(cause)}"
        if own:
            raise RuntimeError(f"{message}; an exception in it is printed above") from error
        if cause == -signal.SIGTERM:
            print(f"{message}: the runs are given back", flush=True)
            raise SystemExit(TERMINATED) from error
        raise ChildProcessError(
            f"{message}. Signal 9 is often for lack of memory. A population keeps its size, and is divided into single runs "
            "if this happens again and again at the same step. To train fewer runs together, from the beginning, remove "
            f"{population}, and give --population"
        ) from error


def _exit_codes(error: BaseException) -> list[int]:
    """Return the exit codes of the processes that have ended, if an error is that of a broken pipe to environments."""
    chain: list[BaseException] = []
    following: BaseException | None = error
    while following is not None and following not in chain:
        chain.append(following)
        following = following.__cause__ or following.__context__
    if not any(isinstance(each, EOFError | ConnectionError) for each in chain):
        return []
    frames = [frame.f_locals.get("self") for each in chain for frame, _ in traceback.walk_tb(each.__traceback__)]
    processes = {process for env in frames if isinstance(env, SubprocVecEnv) for process in env.processes}
    # The exit code is known a moment after the pipe has broken
    ready = connection.wait([process.sentinel for process in processes], GRACE)
    for process in processes:
        if process.sentinel in ready:
            process.join(GRACE)
    return [process.exitcode for process in processes if process.exitcode is not None]


def _in_words(code: int) -> str:
    if code < 0:
        return f"was killed by signal {-code} ({signal.strsignal(-code)})"
    return f"ended with exit code {code}"
