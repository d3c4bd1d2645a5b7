"""
The evaluation of all agents of a population at once.

Shapes: N agents, E episodes of each agent.
"""

import os
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, EventCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv

from sb3_cgp.common.rules import require, require_count
from sb3_cgp.population.algorithm import Population


def evaluate_population(population: Population, env: VecEnv, n_eval_episodes: int = 10) -> tuple[np.ndarray, np.ndarray]:
    """
    Evaluate all agents at once, each in its own environment.

    :param population: the population
    :param env: as many environments as agents
    :param n_eval_episodes: number of episodes of each agent, E
    :return: returns and lengths of the episodes, (N, E) each
    :raises ValueError: if the number of environments is another one
    """
    n_agents = len(population)
    require_count("n_eval_episodes", n_eval_episodes)
    check_eval_env("env", env, population)
    returns: list[list[float]] = [[] for _ in range(n_agents)]
    lengths: list[list[int]] = [[] for _ in range(n_agents)]

    def collect(locals_: dict[str, Any], globals_: dict[str, Any]) -> None:
        """Note whose episode has ended: SB3 calls this for each environment that still has episodes to do."""
        if locals_["done"]:
            index, episode = locals_["i"], locals_["info"].get("episode")
            is_monitored = locals_["is_monitor_wrapped"]
            if is_monitored and episode is None:
                # An end of a life in a wrapper, not of an episode
                return
            returns[index].append(float(episode["r"] if is_monitored else locals_["current_rewards"][index]))
            lengths[index].append(int(episode["l"] if is_monitored else locals_["current_lengths"][index]))

    # SB3 shares the episodes out evenly among the environments
    evaluate_policy(population, env, n_eval_episodes * n_agents, callback=collect, warn=False)
    return np.array(returns), np.array(lengths)


def check_eval_env(name: str, env: Any, population: Population) -> None:
    """
    Check that each agent of a population can be evaluated in an environment of its own.

    :param name: the argument's name
    :param env: the environment
    :param population: the population
    :raises ValueError: if it is no ``VecEnv``, or has another number of environments than the population agents
    """
    n_agents = len(population)
    require(isinstance(env, VecEnv), name, env, f"a VecEnv, as `make_vec_env(task, n_envs={n_agents})` makes it")
    require(env.num_envs == n_agents, f"{name}.num_envs", env.num_envs, f"{n_agents}, as many as agents")


class PopulationEvalCallback(EventCallback):
    """
    Evaluates all agents of a population at once, as SB3's ``EvalCallback`` evaluates one.

    The log has the mean over all agents, the best and the worst agent's. ``evaluations.npz`` holds the agents' own:
    ``timesteps``, (T,), the steps of one agent at T evaluations, ``results`` and ``ep_lengths``, (T, N, E).

    :param eval_env: as many environments as agents
    :param callback_after_eval: callback to trigger after every evaluation
    :param n_eval_episodes: number of episodes of each agent, E
    :param eval_freq: the agents are evaluated every ``eval_freq`` steps of an agent
    :param log_path: folder of ``evaluations.npz``, updated at each evaluation; None to write none
    :param verbose: Verbosity level: 0 for no output, 1 for the mean returns
    """

    def __init__(
        self,
        eval_env: VecEnv,
        callback_after_eval: BaseCallback | None = None,
        n_eval_episodes: int = 5,
        eval_freq: int = 10_000,
        log_path: str | None = None,
        verbose: int = 1,
    ):
        super().__init__(callback_after_eval, verbose=verbose)
        require_count("n_eval_episodes", n_eval_episodes)
        require_count("eval_freq", eval_freq)
        self.eval_env = eval_env
        self.n_eval_episodes = n_eval_episodes
        self.eval_freq = eval_freq
        self.log_path = log_path
        # Of each evaluation: the steps of an agent, and returns and lengths of the episodes, (N, E)
        self.evaluations_timesteps: list[int] = []
        self.evaluations_results: list[np.ndarray] = []
        self.evaluations_length: list[np.ndarray] = []
        # As SB3's callbacks after an evaluation expect them: the mean over all agents
        self.last_mean_reward = self.best_mean_reward = -np.inf

    def _init_callback(self) -> None:
        allowed = "a Population, whose agents PopulationEvalCallback evaluates: use SB3's EvalCallback for a single agent"
        population = self.model
        require(isinstance(population, Population), "model", type(population).__name__, allowed)
        assert isinstance(population, Population)
        check_eval_env("eval_env", self.eval_env, population)

    @property
    def mean_rewards(self) -> np.ndarray:
        """The agents' mean returns at each evaluation, (T, N); of shape (0,) before the first one."""
        return np.array([np.mean(returns, axis=1) for returns in self.evaluations_results])

    def _on_step(self) -> bool:
        if self.n_calls % self.eval_freq != 0:
            return True
        population = self.model
        assert isinstance(population, Population)
        returns, lengths = evaluate_population(population, self.eval_env, self.n_eval_episodes)
        self.evaluations_timesteps.append(self.num_timesteps // len(population))
        self.evaluations_results.append(returns)
        self.evaluations_length.append(lengths)
        if self.log_path is not None:
            os.makedirs(self.log_path, exist_ok=True)
            np.savez(
                os.path.join(self.log_path, "evaluations"),
                timesteps=self.evaluations_timesteps,
                results=np.array(self.evaluations_results),
                ep_lengths=np.array(self.evaluations_length),
            )
        means = returns.mean(axis=1)
        self.last_mean_reward = float(means.mean())
        self.best_mean_reward = max(self.best_mean_reward, self.last_mean_reward)
        if self.verbose >= 1:
            print(f"Eval num_timesteps={self.num_timesteps}, mean rewards of the agents: {np.round(means, 2)}")
        self.logger.record("eval/mean_reward", self.last_mean_reward)
        self.logger.record("eval/best_mean_reward", float(means.max()))
        self.logger.record("eval/worst_mean_reward", float(means.min()))
        self.logger.record("eval/mean_ep_length", float(lengths.mean()))
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(self.num_timesteps)
        return self._on_event()
