"""
The operators of one gradient step of a population, and of one selection of actions in a rollout, without a GPU.

They are recorded from the population's own code, on PyTorch's "meta" device, which has shapes and no values.
"""

import dataclasses
from collections.abc import Sequence

import torch as th
from stable_baselines3 import TD3

from benchmark.speed.contenders import BATCH_SIZE, NET_ARCH
from benchmark.speed.operations import Operation, record_operations, total_flops
from benchmark.speed.population_methods import HALF_CHEETAH, Dimensions, make_box, make_population
from sb3_cgp.population.gradient_step import AgentNumbers, GradientStep
from sb3_cgp.population.policies import PopulationPolicy


@dataclasses.dataclass(frozen=True)
class StepOperations:
    """
    The operators of a population's step.

    :param gradient_steps: those of each gradient step of a cycle: not every step trains the actors and moves the averages
    :param acting: those of a selection of actions
    """

    gradient_steps: Sequence[Sequence[Operation]]
    acting: Sequence[Operation]

    def per_gradient_step(self) -> dict[str, float]:
        """Return the means over the cycle: operators, their products' operations, and bytes."""
        n_steps = len(self.gradient_steps)
        every = [operation for step in self.gradient_steps for operation in step]
        return {
            "operators": len(every) / n_steps,
            "flops": total_flops(every) / n_steps,
            "bytes": sum(operation.n_bytes for operation in every) / n_steps,
        }


def count_step(method: str, n_agents: int, dimensions: Dimensions = HALF_CHEETAH) -> StepOperations:
    """
    Record the operators of a population's step.

    :param method: the method
    :param n_agents: the number of agents
    :param dimensions: of observations and of actions
    :return: the operators
    """
    agent = make_population(method, make_box(dimensions), "cpu", buffer_size=1, learning_starts=1)[0]
    # Copies of one agent: only their number and shapes count
    agents = [agent] * n_agents
    policy = PopulationPolicy(agent.observation_space, agent.action_space, agents).to("meta")  # type: ignore[arg-type]
    numbers = AgentNumbers.of(agents, th.device("meta"))
    delay, interval = agent.policy_delay, agent.target_update_interval

    def meta(*shape: int, dtype: th.dtype = th.float32) -> th.Tensor:
        return th.empty(shape, dtype=dtype, device="meta")

    rows, (n_observed, n_actions) = (n_agents, BATCH_SIZE), dimensions
    batch = (meta(*rows, n_observed), meta(*rows, n_actions), meta(*rows, n_observed), meta(*rows), meta(*rows))
    inputs = (*batch, meta(n_agents, 1), meta(4, n_agents, dtype=th.long))
    cycle = []
    for number in range(1, delay * interval + 1):
        step = GradientStep(policy, numbers, agent.policy_loss, number % delay == 0, number % interval == 0)
        cycle.append(record_operations(lambda step=step: step(*inputs)))  # type: ignore[misc]
    observations = meta(n_agents, 1, n_observed)
    acting = record_operations(lambda: policy.select_actions(policy.features(observations)))
    return StepOperations(cycle, acting)


def count_sb3_td3() -> float:
    """
    Return the number of operators of a gradient step of SB3's TD3, the mean over a step with and one without its actor.

    :return: the number, with the optimizers' operators as on a GPU, one for all parameters
    """
    env = make_box()
    # "foreach" is PyTorch's choice on a GPU
    policy_kwargs = dict(net_arch=NET_ARCH.copy(), optimizer_kwargs=dict(foreach=True))
    model = TD3(
        "MlpPolicy", env, buffer_size=10, learning_starts=4, batch_size=BATCH_SIZE, policy_kwargs=policy_kwargs, device="cpu"
    )
    model.learn(4)
    return len(record_operations(lambda: model.train(2, BATCH_SIZE))) / 2
