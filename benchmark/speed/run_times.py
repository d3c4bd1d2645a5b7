"""Seconds per episode of training and of inference, by method, and their ratios to TD3's."""

import argparse
import os
from collections.abc import Callable
from typing import Any

from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from benchmark.speed.contenders import CONTENDERS, REFERENCE, RandomAgent, make_agent, takes_cem_dtype
from benchmark.speed.timing import interleaved, ratio, summary

# Episodes between two entries in the log, so that none is written
NO_LOG = 10**9


def prepare(agents: dict[str, OffPolicyAlgorithm], steps: int) -> None:
    """
    Train until all initial work is done: filling the buffer, compiling, capturing CUDA graphs.

    :param agents: the models, untrained
    :param steps: environment steps
    """
    for agent in agents.values():
        agent.learn(steps, log_interval=NO_LOG)


def training_episode(agent: OffPolicyAlgorithm, steps: int) -> Callable[[], object]:
    """
    Return a function that trains for an episode, and continues from its last call.

    :param agent: the model
    :param steps: environment steps per episode
    :return: the function to time
    """
    return lambda: agent.learn(steps, log_interval=NO_LOG, reset_num_timesteps=False)


def inference_episode(agent: OffPolicyAlgorithm | RandomAgent, env_id: str, seed: int, steps: int) -> Callable[[], object]:
    """
    Return a function that acts for an episode, and continues from its last call.

    :param agent: the model
    :param env_id: the environment, which is made anew
    :param seed: the environment's seed
    :param steps: environment steps per episode
    :return: the function to time
    """
    env = make_vec_env(env_id, seed=seed)
    observation = env.reset()

    def episode() -> None:
        nonlocal observation
        for _ in range(steps):
            action, _ = agent.predict(observation, deterministic=True)  # type: ignore[arg-type]
            observation, *_ = env.step(action)

    return episode


def make_agents(args: argparse.Namespace) -> tuple[dict[str, OffPolicyAlgorithm | RandomAgent], dict[str, str]]:
    """
    Return the models of the methods that the command line asks for.

    :param args: the command line
    :return: the models, and the reasons why others could not be made
    """
    agents: dict[str, OffPolicyAlgorithm | RandomAgent] = {}
    missing = {}
    for name in args.methods:
        kwargs = {"cem_dtype": args.cem_dtype} if args.cem_dtype is not None and takes_cem_dtype(name) else {}
        env = make_vec_env(args.env, seed=args.seed)
        try:
            agents[name] = make_agent(name, env, args.episode_steps, args.seed, args.device, **kwargs)
        except ImportError as error:
            missing[name] = f"not measured: {error}"
    return agents, missing


def measure(args: argparse.Namespace) -> dict[str, Any]:
    """
    Measure the methods that the command line asks for.

    :param args: the command line
    :return: the number of untimed gradient steps, and under "methods", the measurements by method
    """
    if args.threads == 1:
        # JAX reads this when it is first imported
        os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false")
    agents, missing = make_agents(args)
    steps, burn_in = args.episode_steps, burn_in_steps(args.episode_steps)
    learners = {name: agent for name, agent in agents.items() if isinstance(agent, OffPolicyAlgorithm)}
    prepare(learners, steps + burn_in)
    updates_before = {name: agent._n_updates for name, agent in learners.items()}
    training = {name: training_episode(agent, steps) for name, agent in learners.items()}
    train_seconds = interleaved(training, args.episodes, burn_in=0, device=args.device, title="training")
    inference = {name: inference_episode(agent, args.env, args.seed, steps) for name, agent in agents.items()}
    inference_seconds = interleaved(inference, args.inference_episodes, device=args.device, title="inference")

    methods: dict[str, Any] = {}
    for name in args.methods:
        if name in missing:
            methods[name] = {"missing": missing[name]}
            continue
        contender = CONTENDERS[name]
        methods[name] = {
            "train": figures(train_seconds, name, contender.paper_train),
            "inference": figures(inference_seconds, name, contender.paper_inference),
        }
        if name in learners:
            methods[name]["timed_gradient_steps"] = learners[name]._n_updates - updates_before[name]
    return {"burn_in_steps": burn_in, "methods": methods}


def burn_in_steps(episode_steps: int) -> int:
    """
    Return the number of untimed gradient steps before the first timed one.

    :param episode_steps: environment steps per episode
    :return: a fifth of an episode
    """
    return max(episode_steps // 5, 1)


def figures(seconds: dict[str, list[float]], name: str, paper_ratio: float | None) -> dict[str, Any] | None:
    """
    Summarise the measurements of one method.

    :param seconds: the seconds of every method, by round
    :param name: the method
    :param paper_ratio: the paper's ratio to TD3
    :return: seconds and ratios; None if the method was not timed
    """
    if name not in seconds:
        return None
    reference = seconds.get(REFERENCE)
    return {
        "seconds": summary(seconds[name]),
        "ratio": None if reference is None else ratio(seconds[name], reference),
        "paper_ratio": paper_ratio,
    }
