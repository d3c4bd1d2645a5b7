"""
Many CGP agents in one process.

A :class:`Population` trains N agents in lockstep: the operations of a step are those of one agent, on tensors with an axis of
agents, so that N agents share what it costs to start them.

==========================  ==================================================================================================
part                        how it is made for N agents
==========================  ==================================================================================================
environments                one ``VecEnv`` of N environments, in a few processes; environment i belongs to agent i
replay buffer               one of SB3's, of N environments; agent i samples column i (``replay.py``)
networks                    one network whose parameters have an axis of agents, multiplied by ``baddbmm`` (``networks.py``)
action selector             one call for N B states, with one random generator; the selector is not changed (``policies.py``)
losses                      one backward pass from their sum: no gradient crosses agents (``gradient_step.py``)
optimizer                   one step of Adam, with learning rates, step counts and pauses by agent (``adam.py``)
hyperparameters             numbers become tensors by agent; arguments that change shapes are common (``arguments.py``)
==========================  ==================================================================================================

An agent pauses in a step where it is not due: before its ``learning_starts``, between its ``policy_delay`` and its
``target_update_interval``, and for ever after a loss that is NaN or infinite. Its parameters and its optimizer's state stay as
they are, bit for bit, and the other agents are not affected.

Agent i begins with the networks and the environment that a CGP alone has with its seed. Given the same minibatches and random
numbers, it computes what that CGP computes. In a population, all agents draw from one generator.

The gradient step does not synchronise with the host, and changes its state in place: on a GPU it is a CUDA graph, and
so is the selection of actions in a rollout.
"""

from sb3_cgp.population.algorithm import Population
from sb3_cgp.population.callbacks import PopulationEvalCallback, evaluate_population
from sb3_cgp.population.environments import ChunkedSubprocVecEnv
from sb3_cgp.population.make_environments import make_population_env

__all__ = [
    "ChunkedSubprocVecEnv",
    "Population",
    "PopulationEvalCallback",
    "evaluate_population",
    "make_population_env",
]
