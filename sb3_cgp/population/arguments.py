"""The arguments of a population's agents, and the ordinary CGP that has those of one agent."""

import copy
import inspect
from collections.abc import Sequence
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.noise import ActionNoise, NormalActionNoise, VectorizedActionNoise
from stable_baselines3.common.torch_layers import FlattenExtractor

from sb3_cgp.algorithm import CGP
from sb3_cgp.common.rules import nearest, require, require_count
from sb3_cgp.core import policies as core_policies
from sb3_cgp.fast import policies as fast_policies
from sb3_cgp.guards.construction import check_constructor_arguments
from sb3_cgp.selectors import policies as selector_policies

Arguments = dict[str, Any]

# The arguments of CGP that agents of one population may have of their own: numbers that no shape depends on
OWN = (
    "seed",
    "learning_rate",
    "actor_learning_rate",
    "learning_starts",
    "tau",
    "gamma",
    "action_noise",
    "policy_delay",
    "target_update_interval",
    "target_policy_noise",
    "target_noise_clip",
)
# The arguments that a population has in their place
NOT_AGENTS = ("self", "policy", "env", "device", "_init_setup_model")
DEFAULTS = {name: each.default for name, each in inspect.signature(CGP.__init__).parameters.items()}
COMMON = tuple(name for name in DEFAULTS if name not in (*OWN, *NOT_AGENTS))
# The policies whose networks and scoring a population computes
POLICIES = (core_policies.CGPPolicy, selector_policies.CGPPolicy, fast_policies.CGPPolicy)


def merge_arguments(agents: int | Sequence[Arguments], common: Arguments) -> list[Arguments]:
    """
    Return the arguments of each agent.

    :param agents: the number of agents, or the arguments of each agent's own
    :param common: the arguments of all agents. A seed among them is the first agent's; the next ones count from it.
    :return: arguments of CGP, for each agent
    :raises ValueError: if an argument is unknown, of a wrong type, or differs between agents and may not
    """
    if not isinstance(agents, Sequence):
        require_count("agents", agents)
        agents = [{}] * agents
    require(len(agents) > 0, "agents", agents, "a number, or a sequence of dictionaries, at least one")
    for index, own in enumerate(agents):
        require(isinstance(own, dict), f"agents[{index}]", own, "a dictionary of arguments of CGP")
    for name in {name for each in (common, *agents) for name in each}:
        similar = nearest(name, (*OWN, *COMMON))
        advice = "" if similar is None else f"; the nearest name is `{similar}`"
        require(name in (*OWN, *COMMON), "arguments", name, f"one of {', '.join((*OWN, *COMMON))}{advice}")
    for each in (common, *agents):
        check_constructor_arguments(each)
    seed = common.get("seed")
    # NumPy's integers may overflow
    seeds = [{} if seed is None else {"seed": int(seed) + index} for index in range(len(agents))]
    # JSON, in which SB3 saves, has no tuples
    merged = [_with_plain_train_freq(_with_plain_seed(common | seeds[index] | own)) for index, own in enumerate(agents)]
    for name in COMMON:
        first, *others = (value_of(name, arguments) for arguments in merged)
        for index, value in enumerate(others, start=1):
            allowed = f"{first!r}, as agent 0 has it: agents that differ in `{name}` make several populations"
            require(value == first, f"agents[{index}]['{name}']", value, allowed)
    return merged


def value_of(name: str, arguments: Arguments) -> Any:
    """
    Return the value of an argument of an agent.

    :param name: the argument's name
    :param arguments: the arguments that are given
    :return: its value, or CGP's default; for no keyword arguments, an empty dictionary
    """
    value = arguments.get(name, DEFAULTS[name])
    return {} if value is None and name.endswith("_kwargs") else value


def _with_plain_seed(arguments: Arguments) -> Arguments:
    # Gymnasium takes no integer of NumPy's
    return arguments if arguments.get("seed") is None else arguments | {"seed": int(arguments["seed"])}


def _with_plain_train_freq(arguments: Arguments) -> Arguments:
    frequency = value_of("train_freq", arguments)
    if not isinstance(frequency, tuple) or len(frequency) != 2:
        return arguments
    unit = getattr(frequency[1], "value", frequency[1])
    require(unit == "step", "train_freq", frequency, "in unit 'step' in a population, whose episodes end at different times")
    return arguments | {"train_freq": frequency[0]}


def make_agent(
    policy: type[core_policies.CGPPolicy],
    arguments: Arguments,
    observation_space: spaces.Space,
    action_space: spaces.Space,
    device: th.device | str,
) -> CGP:
    """
    Make an ordinary CGP without an environment and a replay buffer, with the networks of its seed.

    :param policy: the policy's class
    :param arguments: arguments of CGP
    :param observation_space: observation space
    :param action_space: action space
    :param device: device of the networks
    :return: the agent
    :raises ValueError: if an argument is out of its range or contradicts another one
    """
    # The user may change the dictionaries of the agent, and noise may have a state. The population prints the device once.
    own: Arguments = {name: dict(value_of(name, arguments)) for name in ("policy_kwargs", "replay_buffer_kwargs")}
    own |= {"action_noise": copy.deepcopy(arguments.get("action_noise")), "verbose": 0}
    agent = CGP(policy, None, device=device, _init_setup_model=False, **(arguments | own))  # type: ignore[arg-type]
    agent.verbose = value_of("verbose", arguments)
    # As SB3's `load` does for a model without an environment. Copies, as the agent's seed is set in its action space.
    agent.observation_space, agent.action_space = copy.deepcopy((observation_space, action_space))
    agent.n_envs, agent._defers_replay_buffer = 1, True
    agent._setup_model()
    return agent


def check_observations(observation_space: spaces.Space) -> None:
    """
    Refuse observations that the networks of a population do not take.

    :param observation_space: observation space
    :raises ValueError: if it is no ``Box``
    """
    allowed = "a Box in a population, whose networks are MLPs: train agents with other observations one by one"
    require(isinstance(observation_space, spaces.Box), "observation_space", observation_space, allowed)


def check_supported(policy: Any, arguments: Arguments) -> None:
    """
    Refuse arguments that an agent alone takes and a population does not, before the agents are made.

    :param policy: the policy's class
    :param arguments: the first agent's arguments
    :raises ValueError: naming the argument, its value, and what is allowed
    """
    require(policy in POLICIES, "policy", policy, "'MlpPolicy' in a population")
    buffer_class = value_of("replay_buffer_class", arguments)
    allowed = "None in a population, which samples the columns of SB3's own buffers"
    require(buffer_class is None, "replay_buffer_class", buffer_class, allowed)
    saves_memory = value_of("optimize_memory_usage", arguments)
    require(not saves_memory, "optimize_memory_usage", saves_memory, "False in a population")
    loss = value_of("policy_loss", arguments)
    require(loss in ("cgp", "qgp", None), "policy_loss", loss, "'cgp', 'qgp' or None in a population")
    dtype = value_of("cem_dtype", arguments)
    require(dtype != "bfloat16", "cem_dtype", dtype, "'auto' or 'float32' in a population, which scores in float32")


def check_networks(agent: CGP) -> None:
    """
    Refuse networks and optimizers that cannot be stacked.

    :param agent: an agent
    :raises ValueError: naming the entry of ``policy_kwargs``, its value, and what is allowed
    """
    extractor = agent.critic.features_extractor
    allowed = "FlattenExtractor in a population"
    require(type(extractor) is FlattenExtractor, "policy_kwargs['features_extractor_class']", type(extractor), allowed)
    for optimizer in (agent.actor.optimizer, agent.critic.optimizer):
        is_adam = type(optimizer) is th.optim.Adam
        require(is_adam, "policy_kwargs['optimizer_class']", type(optimizer), "torch.optim.Adam in a population")
        for name in ("weight_decay", "amsgrad", "maximize"):
            value = optimizer.defaults[name]
            require(not value, f"policy_kwargs['optimizer_kwargs']['{name}']", value, "0 or False in a population")


def join_action_noise(agents: Sequence[CGP]) -> VectorizedActionNoise | None:
    """
    Return the action noise of all agents, each of its own.

    :param agents: the agents, all with noise of the same class, or none of them; without noise stands for a zero Gaussian
    :return: the noise of the environments; None if no agent has any
    :raises ValueError: if the agents' noises are of different classes, or of several environments
    """
    noises = [agent.action_noise for agent in agents]
    if all(noise is None for noise in noises):
        return None
    for index, noise in enumerate(noises):
        is_of_one = not isinstance(noise, VectorizedActionNoise)
        allowed = "the noise of one agent: a population gives a copy to each"
        require(is_of_one, f"agents[{index}]['action_noise']", noise, allowed)
    first, given = next((index, noise) for index, noise in enumerate(noises) if noise is not None)
    zeros = th.zeros(agents[0].action_space.shape or ()).numpy()
    joined: list[ActionNoise] = []
    for index, noise in enumerate(noises):
        stands_for_none = noise is None and isinstance(given, NormalActionNoise)
        own = NormalActionNoise(zeros, zeros) if stands_for_none else noise
        allowed = f"of agent {first}'s class, {type(given).__name__}, with standard deviation 0 for no noise"
        require(type(own) is type(given), f"agents[{index}]['action_noise']", noise, allowed)
        assert own is not None
        joined.append(own)
    vectorized = VectorizedActionNoise(given, len(joined))
    vectorized.noises = joined
    return vectorized
