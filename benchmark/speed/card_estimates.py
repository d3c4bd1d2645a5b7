"""
Estimates of a population's agent-steps per second on a GPU, from counted operators and a recorded run-time table.

An operator takes the time of its launch, and the longer one of its products' and its memory's times at the card's rates. Two
costs of a launch are derived from the recorded times of one agent on the card: within a CUDA graph, from what CEM's further
iterations take (CGP-4 less CGP-2); one at a time from the host, from SB3's TD3.
"""

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmark.speed.operations import Operation
from benchmark.speed.population_counts import StepOperations, count_sb3_td3, count_step

RECORDS = Path(__file__).parents[1] / "results"
GPU_RECORD = RECORDS / "runtime_gpu" / "runtime.json"
# Keys of the estimates
GRAPH, NO_GRAPH = "with a CUDA graph", "without a CUDA graph"
CPU_RECORD = RECORDS / "runtime" / "runtime.json"


@dataclass(frozen=True)
class Card:
    """
    A GPU, and the host beside it.

    :param name: the GPU's name
    :param flops_per_second: rate of products in float32, without tensor cores
    :param bytes_per_second: bandwidth of its memory
    :param source: where the two are from
    :param cores: cores of the host, each of which steps environments
    """

    name: str
    flops_per_second: float
    bytes_per_second: float
    source: str
    cores: int


H100 = Card("NVIDIA H100 80GB HBM3 (SXM)", 67e12, 3.35e12, "NVIDIA's data sheet of the H100", 16)


@dataclass(frozen=True)
class Costs:
    """
    Costs in seconds, derived from recorded times of one agent.

    :param graph_launch: cost of an operator within a CUDA graph
    :param host_launch: cost of an operator that the host launches on its own, by Python
    :param host_rest: the rest of an environment step of one agent: storing, sampling, Python, without the simulator
    :param simulator: a step of one environment
    """

    graph_launch: float
    host_launch: float
    host_rest: float
    simulator: float


def work_seconds(operations: Iterable[Operation], card: Card) -> float:
    """
    Return the time that operators take without their launches.

    :param operations: the operators
    :param card: the GPU
    :return: seconds, a lower bound
    """
    return sum(
        max(operation.flops / card.flops_per_second, operation.n_bytes / card.bytes_per_second) for operation in operations
    )


def _mean_work(step: StepOperations, card: Card) -> tuple[float, float]:
    """Return the operators of a mean gradient step, and their time without launches."""
    n_steps = len(step.gradient_steps)
    every = [operation for each in step.gradient_steps for operation in each]
    return len(every) / n_steps, work_seconds(every, card) / n_steps


def derive_costs(card: Card) -> Costs:
    """
    Derive the costs of launches from this repository's records of single agents.

    :param card: the GPU of the record
    :return: the costs
    """
    methods = json.loads(GPU_RECORD.read_text())["methods"]
    # Seconds per episode of 1,000 steps
    train = {name: methods[name]["train"]["seconds"]["median"] / 1000 for name in ("TD3", "CGP-2", "CGP-4")}
    inference = methods["TD3"]["inference"]["seconds"]["median"] / 1000
    simulator = json.loads(CPU_RECORD.read_text())["methods"]["Random"]["inference"]["seconds"]["median"] / 1000
    counted = {}
    for name in ("CGP-2", "CGP-4"):
        step = count_step(name, 1)
        # One agent selects its action in a rollout by a CUDA graph, too
        n_operators, work = _mean_work(step, card)
        counted[name] = n_operators + len(step.acting), work + work_seconds(step.acting, card)
    (n_short, short), (n_long, long) = counted["CGP-2"], counted["CGP-4"]
    graph_launch = (train["CGP-4"] - train["CGP-2"] - (long - short)) / (n_long - n_short)
    host_rest = train["CGP-2"] - simulator - n_short * graph_launch - short
    return Costs(
        graph_launch=max(graph_launch, 0.0),
        host_launch=(train["TD3"] - inference) / count_sb3_td3(),
        host_rest=max(host_rest, 0.0),
        simulator=simulator,
    )


def estimate(step: StepOperations, n_agents: int, card: Card, costs: Costs) -> dict[str, Any]:
    """
    Estimate a population's step on a GPU.

    :param step: the operators of its step
    :param n_agents: the number of agents
    :param card: the GPU
    :param costs: the costs of launches and of the host
    :return: seconds of the parts of a step, and agent-steps per second with and without a CUDA graph
    """
    n_operators, work = _mean_work(step, card)
    # Environments are shared out among the cores
    simulators = -(-n_agents // card.cores) * costs.simulator
    acting_work, n_acting = work_seconds(step.acting, card), len(step.acting)
    # The host launches operators while the GPU computes; a graph is one launch of the host's
    acting, gradient = (
        {
            GRAPH: costs.host_launch + number * costs.graph_launch + own_work,
            NO_GRAPH: max(number * costs.host_launch, own_work),
        }
        for number, own_work in ((n_acting, acting_work), (n_operators, work))
    )
    seconds = {name: simulators + costs.host_rest + acting[name] + gradient[name] for name in (GRAPH, NO_GRAPH)}
    flops = step.per_gradient_step()["flops"]
    return {
        "seconds": {"simulators": simulators, "host": costs.host_rest, "acting": acting, "work": work, "gradient": gradient},
        "agent_steps_per_second": {name: n_agents / each for name, each in seconds.items()},
        "share_of_product_rate": flops / seconds[GRAPH] / card.flops_per_second,
    }


def estimate_all(methods: Iterable[str], numbers: Iterable[int]) -> dict[str, Any]:
    """
    Count the operators of populations, and estimate their speeds on an NVIDIA H100.

    :param methods: the methods
    :param numbers: the numbers of agents
    :return: the card, the costs, and under "points", counts and estimates by method and number
    """
    costs = derive_costs(H100)
    numbers = list(numbers)
    points = []
    for method in methods:
        for n_agents in numbers:
            step = count_step(method, n_agents)
            counts = step.per_gradient_step() | {"acting_operators": len(step.acting)}
            points.append({"method": method, "n_agents": n_agents, "counts": counts, **estimate(step, n_agents, H100, costs)})
    return {"card": asdict(H100), "costs": asdict(costs), "points": points}
