"""Processes of a population's environments: their number, how they are started, and which environments each of them has."""

import multiprocessing as mp
import os

from sb3_cgp.common.rules import require, require_choice, require_count


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def choose_processes(n_processes: int | None, n_envs: int, start_method: str | None) -> int:
    """
    Return the number of processes, after a check of it and of how they are to be started.

    :param n_processes: number of processes; None for one for each available core, at most one for each environment
    :param n_envs: number of environments
    :param start_method: how processes are started; None for the default
    :return: number of processes
    :raises ValueError: if the number is out of its range, or this platform does not have the start method
    """
    if start_method is not None:
        require_choice("start_method", start_method, mp.get_all_start_methods())
    if n_processes is None:
        return min(available_cores(), n_envs)
    require_count("n_processes", n_processes)
    require(n_processes <= n_envs, "n_processes", n_processes, f"at most {n_envs}, the number of environments")
    return n_processes


def chunk_bounds(n_envs: int, n_processes: int) -> list[tuple[int, int]]:
    """
    Share environments out among processes, in order, as evenly as possible.

    :param n_envs: number of environments
    :param n_processes: number of processes
    :return: the first environment of each process, and the first one of the next process
    """
    return [(index * n_envs // n_processes, (index + 1) * n_envs // n_processes) for index in range(n_processes)]
