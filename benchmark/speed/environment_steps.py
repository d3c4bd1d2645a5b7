"""The time of a step of many environments, by the way of stepping them."""

import argparse
import multiprocessing
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from benchmark.speed.environment_ways import WAYS, Way
from benchmark.speed.timing import interleaved, ratio, summary

# All ratios are to this way
REFERENCE = "subproc"
BURN_IN = 2


class Stepper:
    """
    Environments that are stepped by random actions, and the processor's time that they take.

    :param way: how they are stepped
    :param env_id: the environment
    :param n_envs: number of environments
    :param n_processes: number of processes or threads
    :param seed: seed of the environments and of the actions
    :param steps: steps of each call
    """

    def __init__(self, way: Way, env_id: str, n_envs: int, n_processes: int, seed: int, steps: int):
        start = time.perf_counter()
        self.env: VecEnv = way.make(env_id, n_envs, n_processes, seed)
        self.env.reset()
        self.start_seconds = time.perf_counter() - start
        generator = np.random.default_rng(seed)
        space: Any = self.env.action_space
        shape = (steps, n_envs, *space.shape)
        self._actions = generator.uniform(space.low, space.high, shape).astype(space.dtype)
        self.cpu_seconds: list[float | None] = []

    def __call__(self) -> None:
        """Take the steps, and note the processor's time."""
        before = self._cpu_seconds()
        for actions in self._actions:
            self.env.step(actions)
        after = self._cpu_seconds()
        self.cpu_seconds.append(None if before is None or after is None else after - before)

    def _cpu_seconds(self) -> float | None:
        """Return the processor's time of this process with its threads and of the environments' processes, on Linux."""
        holder = getattr(self.env, "_env", self.env)
        workers = [_process_seconds(process.pid) for process in getattr(holder, "processes", [])]
        known = [seconds for seconds in workers if seconds is not None]
        return None if len(known) < len(workers) else time.process_time() + sum(known)


def _process_seconds(pid: int) -> float | None:
    """Return the processor's time of another process; None on other systems than Linux."""
    stat = Path(f"/proc/{pid}/stat")
    if not stat.exists():
        return None
    # The name in brackets may contain blanks
    fields = stat.read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def preload() -> None:
    """Let processes begin with what environments import, so that hundreds of them start soon and share its memory."""
    multiprocessing.set_forkserver_preload(
        ["benchmark.speed.environment_ways", "sb3_cgp.population.environments", "gymnasium.envs.mujoco.half_cheetah_v5"]
    )


def measure_number(args: argparse.Namespace, n_envs: int) -> list[dict[str, Any]]:
    """
    Measure all ways for a number of environments, in turn.

    :param args: the command line
    :param n_envs: the number of environments
    :return: the figures of each way
    """
    n_processes = min(args.processes, n_envs)
    missing = {name: WAYS[name].reason_missing() for name in args.ways}
    steppers: dict[str, Stepper] = {}
    try:
        for name in args.ways:
            if missing[name] is None:
                steppers[name] = Stepper(WAYS[name], args.env, n_envs, n_processes, args.seed, args.steps)
        runs: dict[str, Callable[[], object]] = dict(steppers)
        seconds = interleaved(runs, args.rounds, burn_in=BURN_IN, title=f"{n_envs} environments")
    finally:
        for stepper in steppers.values():
            stepper.env.close()
    n_steps = args.steps * n_envs
    return [
        {"way": name, "title": WAYS[name].title, "n_envs": n_envs, "n_processes": n_processes}
        | (
            {"missing": missing[name]}
            if missing[name] is not None
            else figures(seconds[name], seconds.get(REFERENCE), steppers[name], n_steps)
        )
        for name in args.ways
    ]


def figures(seconds: Sequence[float], reference: Sequence[float] | None, stepper: Stepper, n_steps: int) -> dict[str, Any]:
    """
    Summarise the measurements of one way.

    :param seconds: seconds of each call
    :param reference: those of the reference in the same rounds; None if it was not measured
    :param stepper: the environments
    :param n_steps: steps of all environments in a call
    :return: steps per second, the speed as a ratio to the reference's, microseconds of a processor per step, seconds to start
    """
    processor = [each for each in stepper.cpu_seconds[BURN_IN:] if each is not None]
    return {
        "steps_per_second": summary([n_steps / each for each in seconds]),
        "ratio": None if reference is None else ratio(reference, seconds),
        "processor_microseconds_per_step": summary([1e6 * each / n_steps for each in processor]) if processor else None,
        "start_seconds": stepper.start_seconds,
    }


def measure(args: argparse.Namespace, write: Callable[[dict[str, Any]], object]) -> dict[str, Any]:
    """
    Measure the numbers of environments that the command line asks for.

    :param args: the command line
    :param write: writes the fields of the record that there are, after each number of environments
    :return: under "points", the figures of each way and number
    """
    preload()
    points: list[dict[str, Any]] = []
    for n_envs in args.numbers:
        points += measure_number(args, n_envs)
        write({"points": points})
    return {"points": points}
