"""The speed of a population by the number of its agents, and the parts of a step."""

import argparse
import gc
import os
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from benchmark.speed.contenders import BATCH_SIZE, make_agent
from benchmark.speed.operations import bare_products, total_flops
from benchmark.speed.population_counts import count_step
from benchmark.speed.population_methods import Dimensions, make_population
from benchmark.speed.timing import summary, timed
from sb3_cgp.population import make_population_env

# Of each agent. Enough for the measured steps, in as much memory as many agents can have
BUFFER_SIZE = 20_000
# Random steps of each agent before its first gradient step
WARM_UP = 200
# Gradient steps before the first timed one, in which libraries allocate memory and graphs are recorded
BURN_IN = 20
NO_LOG = 10**9
# Stands for an ordinary model alone, in the place of a number of agents
ALONE = 0


class TimedVecEnv(VecEnvWrapper):
    """
    Environments whose steps are timed.

    :param venv: the environments
    """

    def __init__(self, venv: VecEnv):
        super().__init__(venv)
        self.seconds = 0.0

    def reset(self) -> Any:
        """Reset the environments, and return the observations."""
        return self.venv.reset()

    def step_async(self, actions: np.ndarray) -> None:
        """
        Begin a step.

        :param actions: the actions
        """
        start = time.perf_counter()
        self.venv.step_async(actions)
        self.seconds += time.perf_counter() - start

    def step_wait(self) -> VecEnvStepReturn:
        """Wait for a step, and return what it returns."""
        start = time.perf_counter()
        results = self.venv.step_wait()
        self.seconds += time.perf_counter() - start
        return results


def points_in_order(methods: list[str], numbers: list[int]) -> Iterator[tuple[str, int]]:
    """
    List the points to measure: those of single models and of the largest gain first, for all methods, so that a measurement
    that ends early has what matters.

    :param methods: the methods
    :param numbers: numbers of agents
    :return: method and number of agents, :data:`ALONE` for an ordinary model
    """
    valuable = [number for number in (1, 32, 8, 64) if number in numbers]
    for number in [ALONE, *valuable, *(number for number in numbers if number not in valuable)]:
        for method in methods:
            yield method, number


def make_model(method: str, n_agents: int, env: VecEnv, args: argparse.Namespace) -> OffPolicyAlgorithm:
    """
    Make the population of a point, or the ordinary model in its place.

    :param method: the method
    :param n_agents: the number of agents, :data:`ALONE` for an ordinary model
    :param env: the environments
    :param args: the command line
    :return: the model
    """
    if n_agents == ALONE:
        model = make_agent(method, env, WARM_UP, args.seed, args.device)
        assert isinstance(model, OffPolicyAlgorithm)
        return model
    arguments = dict(learning_starts=WARM_UP, buffer_size=BUFFER_SIZE)
    return make_population(method, env, args.device, args.seed, **arguments)


def measure_point(method: str, n_agents: int, args: argparse.Namespace) -> dict[str, Any]:
    """
    Measure a point.

    :param method: the method
    :param n_agents: the number of agents, :data:`ALONE` for an ordinary model
    :param args: the command line
    :return: agent-steps per second, the seconds of a step and of its parts, operations and memory
    """
    n_envs = max(n_agents, 1)
    # What the last point has left behind would count in this one's memory
    gc.collect()
    if args.device.type == "cuda":
        th.cuda.empty_cache()
        th.cuda.reset_peak_memory_stats(args.device)
    env = TimedVecEnv(make_population_env(args.env, n_envs, min(args.processes, n_envs), args.seed))
    try:
        figures = time_steps(make_model(method, n_agents, env, args), env, args)
        dimensions = env.observation_space.shape[0], env.action_space.shape[0]  # type: ignore[index]
    finally:
        env.close()
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    point = {"method": method, "n_agents": n_agents, **figures, "load_average": load}
    return point if n_agents == ALONE else point | measure_products(method, n_agents, dimensions, args)


def time_steps(model: OffPolicyAlgorithm, env: TimedVecEnv, args: argparse.Namespace) -> dict[str, Any]:
    """
    Time the steps of a model, its environments' part of them, and its gradient steps alone.

    :param model: the model
    :param env: its environments
    :param args: the command line
    :return: agent-steps per second, seconds, and the memory in use afterwards
    """
    n_envs, device = env.num_envs, args.device
    model.learn((WARM_UP + BURN_IN) * n_envs, log_interval=NO_LOG)
    step_seconds, simulator_seconds, gradient_seconds = [], [], []
    for _ in range(args.rounds):
        env.seconds = 0.0
        learn = partial(model.learn, args.steps * n_envs, log_interval=NO_LOG, reset_num_timesteps=False)
        step_seconds.append(timed(learn, device) / args.steps)
        simulator_seconds.append(env.seconds / args.steps)
        gradient_seconds.append(timed(partial(model.train, args.steps, BATCH_SIZE), device) / args.steps)
    return {
        "agent_steps_per_second": summary([n_envs / each for each in step_seconds]),
        "step_seconds": summary(step_seconds),
        "simulator_seconds": summary(simulator_seconds),
        "gradient_step_seconds": summary(gradient_seconds),
        "memory_bytes": _memory(device),
    }


def measure_products(method: str, n_agents: int, dimensions: Dimensions, args: argparse.Namespace) -> dict[str, Any]:
    """
    Time the matrix products of a step alone.

    :param method: the method
    :param n_agents: the number of agents
    :param dimensions: of observations and of actions
    :param args: the command line
    :return: the seconds of a mean step's products, and their operations
    """
    step = count_step(method, n_agents, dimensions)
    cycle = [operation for each in step.gradient_steps for operation in each]
    n_steps = len(step.gradient_steps)
    run = as_graph(bare_products([*cycle, *list(step.acting) * n_steps], args.device), args.device)
    run()
    seconds = [timed(run, args.device) / n_steps for _ in range(args.rounds)]
    return {"product_seconds": summary(seconds), "flops": total_flops(cycle) / n_steps + total_flops(step.acting)}


def as_graph(run: Callable[[], object], device: th.device) -> Callable[[], object]:
    """
    Return a function as a CUDA graph, so that launches are not what is timed.

    :param run: the function
    :param device: the device
    :return: the graph's replay on a GPU, the function itself elsewhere
    """
    if device.type != "cuda":
        return run
    run()
    graph = th.cuda.CUDAGraph()
    with th.cuda.graph(graph):
        run()
    return graph.replay


def measure_product_rate(device: th.device) -> dict[str, Any]:
    """
    Measure the device's rate of large matrix products in float32.

    :param device: the device
    :return: floating-point operations per second, in the fastest of five products, and the size
    """
    size = 8192 if device.type == "cuda" else 1024
    left, right = (th.randn(size, size, device=device) for _ in range(2))
    result = left @ right
    seconds = min(timed(lambda: th.mm(left, right, out=result), device) for _ in range(5))
    return {"flops_per_second": 2 * size**3 / seconds, "size": size}


def _memory(device: th.device) -> int | None:
    """Return the largest memory allocated on a GPU, or the resident memory of this process on Linux."""
    if device.type == "cuda":
        return th.cuda.max_memory_allocated(device)
    statm = Path("/proc/self/statm")
    return int(statm.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") if statm.exists() else None
