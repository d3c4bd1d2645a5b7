"""Making the environments of a population."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv

from sb3_cgp.common.rules import require, require_count
from sb3_cgp.population.environments import ChunkedSubprocVecEnv
from sb3_cgp.population.processes import choose_processes
from sb3_cgp.resumption.environments import RestorableEnv


def make_population_env(
    env_id: str | Callable[..., gym.Env],
    n_agents: int,
    n_processes: int | None = None,
    seed: int | None = None,
    wrapper_class: Callable[[gym.Env], gym.Env] | None = None,
    wrapper_kwargs: dict[str, Any] | None = None,
    start_method: str | None = None,
    **kwargs: Any,
) -> VecEnv:
    """
    Make the environments of a population, as SB3's ``make_vec_env`` does, in processes that step several of them each.

    They can be restored: :class:`~sb3_cgp.RestorableEnv` is the outermost wrapper of each.

    :param env_id: either the env ID, the env class or a callable returning an env
    :param n_agents: number of environments, one for each agent
    :param n_processes: number of processes, at most ``n_agents``; 1 for a ``DummyVecEnv``, which steps them in this process;
        None for one process for each core that this process may use
    :param seed: the seed of the first environment; those of the next ones count from it
    :param wrapper_class: a wrapper, or a function that wraps an environment
    :param wrapper_kwargs: the wrapper's keyword arguments
    :param start_method: how processes are started, see :class:`ChunkedSubprocVecEnv`
    :param kwargs: the further arguments of ``make_vec_env``, such as ``env_kwargs``
    :return: the environments
    :raises ValueError: if a number is out of its range, or the start method or an argument is not allowed
    :raises RuntimeError: if a process ends before it has made its environments
    """
    for name in ("vec_env_cls", "vec_env_kwargs"):
        allowed = "left out: `n_processes` chooses the class; SB3's `make_vec_env` makes environments of another one"
        require(name not in kwargs, name, kwargs.get(name), allowed)
    require_count("n_agents", n_agents)
    n_processes = choose_processes(n_processes, n_agents, start_method)

    def wrap(env: gym.Env) -> gym.Env:
        return RestorableEnv(env if wrapper_class is None else wrapper_class(env, **(wrapper_kwargs or {})))

    in_processes: dict[str, Any] = {}
    if n_processes > 1:
        chunks = {"n_processes": n_processes, "start_method": start_method}
        in_processes = {"vec_env_cls": ChunkedSubprocVecEnv, "vec_env_kwargs": chunks}
    return make_vec_env(env_id, n_agents, seed, wrapper_class=wrap, **in_processes, **kwargs)


def make_agents_env(env: Any, n_agents: int) -> Any:
    """
    Make the environments of a population if the name of an environment is given, as its constructor does.

    :param env: the name of an environment, or the environments
    :param n_agents: number of environments, one for each agent
    :return: the environments
    """
    return make_vec_env(env, n_agents) if isinstance(env, str) else env
