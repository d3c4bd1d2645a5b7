"""The population: SB3's loop around the gradient step of many agents."""

import io
import pathlib
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback

from sb3_cgp.algorithm import CGP
from sb3_cgp.common.load_arguments import saved_attributes
from sb3_cgp.common.rules import require
from sb3_cgp.common.sb3_arguments import as_schedule
from sb3_cgp.core.cem import ActionSelector
from sb3_cgp.core.policies import CGPPolicy
from sb3_cgp.guards.argument_names import suggests_names
from sb3_cgp.guards.file_names import find_file
from sb3_cgp.guards.observations import innermost
from sb3_cgp.population.arguments import (
    COMMON,
    OWN,
    Arguments,
    check_networks,
    check_observations,
    check_supported,
    join_action_noise,
    make_agent,
    merge_arguments,
    value_of,
)
from sb3_cgp.population.gradient_step import AgentNumbers
from sb3_cgp.population.make_environments import make_agents_env
from sb3_cgp.population.members import PopulationMembers
from sb3_cgp.population.policies import PopulationPolicy
from sb3_cgp.resumption.algorithm import ResumableAlgorithm

SelfPopulation = TypeVar("SelfPopulation", bound="Population")

# The arguments that are fixed when a population is made. SB3 and the user may set the others on it.
FIXED = {"agents", "overlap", *OWN, *COMMON} - {"seed", "stats_window_size", "tensorboard_log", "verbose"}


class Population(ResumableAlgorithm, PopulationMembers):
    """
    N agents of CGP that are trained in lockstep, each in its own environment.

    ``population[i]`` is agent i as an ordinary :class:`sb3_cgp.CGP`. As SB3 does with several environments,
    ``num_timesteps`` and the ``total_timesteps`` of ``learn`` count the steps of all environments; the agents' arguments, such
    as ``learning_starts`` and ``buffer_size``, count those of one agent. CGP's diagnostics are not logged.

    :param policy: "MlpPolicy", or its class
    :param env: the name of an environment, which is made once for each agent, or a ``VecEnv`` of N environments
    :param agents: the number of agents, or for each agent a dictionary of the arguments that it does not share: ``seed``,
        ``learning_rate``, ``actor_learning_rate``, ``learning_starts``, ``tau``, ``gamma``, ``action_noise``,
        ``policy_delay``, ``target_update_interval``, ``target_policy_noise`` and ``target_noise_clip``
    :param overlap: whether gradient steps are taken while the environments take their step, in the processes of
        :func:`make_population_env`. It changes what is learnt: a gradient step cannot sample the newest transition.
    :param device: Device (cpu, cuda, ...) on which the code should be run.
    :param arguments: CGP's arguments for all agents. With ``seed``, agent i has the seed ``seed + i``.
    :param _init_setup_model: Whether or not to build the network at the creation of the instance
    :raises ValueError: if an argument is out of its range, differs between agents and may not, or is not supported
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = CGP.policy_aliases
    # For TensorBoard's tab HParams. SB3's attributes, such as `gamma`, have not the agents' values, which are in `agents`.
    hyperparameter_names: ClassVar[tuple[str, ...]] = ("agents", "overlap", "device")
    # That of the policy when the population was saved
    _saved_selector: ActionSelector | None = None

    def __init__(
        self,
        policy: str | type[CGPPolicy],
        env: GymEnv | str | None,
        agents: int | Sequence[Arguments] = 1,
        *,
        overlap: bool = False,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
        **arguments: Any,
    ):
        self.agents = merge_arguments(agents, arguments)
        self.overlap = overlap
        first = self.agents[0]
        self.cuda_graphs = value_of("cuda_graphs", first)
        self._failures: list[str | None] = [None] * len(self.agents)
        self._agent_updates = np.zeros(len(self.agents), dtype=np.int64)
        self._policies_trained, self._policies_due = (np.zeros(len(self.agents), dtype=bool) for _ in range(2))
        super().__init__(
            policy,
            make_agents_env(env, len(self.agents)),
            value_of("learning_rate", first),
            policy_kwargs=value_of("policy_kwargs", first),
            replay_buffer_kwargs=value_of("replay_buffer_kwargs", first),
            stats_window_size=value_of("stats_window_size", first),
            tensorboard_log=value_of("tensorboard_log", first),
            verbose=value_of("verbose", first),
            seed=value_of("seed", first),
            device=device,
            support_multi_env=True,
            sde_support=False,
        )
        if _init_setup_model:
            self._setup_model()

    def _setup_lr_schedule(self) -> None:
        # Not used: each agent has its own, `_schedules`
        self.lr_schedule = as_schedule(self.learning_rate)

    def _setup_model(self) -> None:
        n_agents = len(self)
        # `load` sets the spaces where there is no environment
        has_space = getattr(self, "observation_space", None) is not None
        require(
            has_space, "env", None, "the name of an environment, or a VecEnv with one for each agent: only `load` needs none"
        )
        self._check_env()
        check_supported(self.policy_class, self.agents[0])
        check_observations(self.observation_space)
        spaces = self.observation_space, self.action_space
        # On the CPU, where a CGP alone draws its first parameters too
        agents = [make_agent(self.policy_class, each, *spaces, "cpu") for each in self.agents]  # type: ignore[arg-type]
        check_networks(agents[0])
        for name in ("batch_size", "n_steps", "train_freq", "gradient_steps"):
            setattr(self, name, getattr(agents[0], name))
        self._check_overlap()
        # SB3 divides the one by the number of environments, and compares the other with the steps of all
        self.buffer_size = n_agents * agents[0].buffer_size
        self.learning_starts = n_agents * min(agent.learning_starts for agent in agents)
        # SB3 makes a policy, which is replaced below: the random numbers that follow are those of an agent alone
        super()._setup_model()
        # A loaded population has its noise, with a state
        if self.action_noise is None:
            self.action_noise = join_action_noise(agents)
        # From here on, the arguments are fixed
        self.policy = PopulationPolicy(*spaces, agents).to(self.device)  # type: ignore[arg-type]
        if self._saved_selector is not None:
            self.policy.selector = self._saved_selector
        self._choose_inference()
        self._schedules = [(agent.lr_schedule, agent.actor_lr_schedule) for agent in agents]
        self._numbers = AgentNumbers.of(agents, self.device)
        names = ("learning_starts", "policy_delay", "target_update_interval")
        self._counts = {name: np.array([getattr(agent, name) for agent in agents]) for name in names}
        self._recorded = {}
        self._unlogged = {}

    def __setattr__(self, name: str, value: Any) -> None:
        """
        Set an attribute, unless it is an argument of the population or of its agents, which would then contradict each other.

        :param name: the attribute's name
        :param value: its value
        :raises ValueError: if the population is made and the attribute is such an argument
        """
        advice = "make another one, or set an agent's argument on `population.agent(i, env)`"
        is_made = isinstance(vars(self).get("policy"), PopulationPolicy)
        require(name not in FIXED or not is_made, name, value, f"left as it is in a population that is made: {advice}")
        super().__setattr__(name, value)

    def save(self, *args: Any, **kwargs: Any) -> None:
        """
        Save the population, with the selector of its policy, see SB3's method.

        :param args: the arguments of SB3's method
        :param kwargs: the same arguments by keyword
        """
        self._saved_selector = self.policy.selector
        super().save(*args, **kwargs)

    def set_random_seed(self, seed: int | None = None) -> None:
        """
        Set the seeds of the random generators, and the agents' own ones of their environments.

        :param seed: the seed of the generators that the agents share
        """
        # Not `env.unwrapped`, which an environment of no class of SB3's may lack
        env = innermost(self.env)
        seeds_before = [] if env is None else list(env._seeds)
        super().set_random_seed(seed)
        if env is not None:
            # SB3 counts the environments' seeds from one number. As with CGP alone, no seed leaves the environment's own.
            own = [arguments.get("seed") for arguments in self.agents]
            env._seeds = [before if each is None else each for each, before in zip(own, seeds_before, strict=True)]

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, Any]:
        # `set_env` may have changed it
        self._check_env()
        # The user may have set another selector on the policy. To make an agent repeats the constructor's warnings.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            agent = self[0]
        agent._check_selector()
        return super()._setup_learn(*args, **kwargs)

    def _check_env(self) -> None:
        """
        Check that the environments are the agents' own.

        :raises ValueError: if there are more or fewer than agents, or they share the statistics of ``VecNormalize``
        """
        if self.env is not None:
            self._check_n_envs(self.env.num_envs)
        allowed = "without VecNormalize, whose statistics all agents would share"
        require(self._vec_normalize_env is None, "env", self.env, allowed)

    def _check_n_envs(self, n_envs: int) -> None:
        require(n_envs == len(self), "env.num_envs", n_envs, f"{len(self)}, as many as agents: environment i is agent i's")

    @suggests_names
    def learn(
        self: SelfPopulation,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "Population",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfPopulation:
        """
        Learn as SB3's algorithms do. With offline training, train the actors at the end, one after another: those of the
        agents whose critics have learnt. Callbacks take no part in that; a state of the training is saved after each actor.

        :param total_timesteps: number of steps of all environments together
        :param callback: callback(s) called at every step with state of the algorithm.
        :param log_interval: number of episodes, of all environments together, between two writings of the log
        :param tb_log_name: the name of the run for TensorBoard logging
        :param reset_num_timesteps: whether or not to reset the current timestep number (used in logging)
        :param progress_bar: Display a progress bar using tqdm and rich.
        :return: the trained population
        :raises ValueError: if all agents have failed
        """
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)

    def _make_agent(self, index: int) -> CGP:
        agent = super()._make_agent(index)
        agent._training_has_ended = self._training_has_ended
        return agent

    def _train_policy(self, index: int) -> bool:
        is_trained = super()._train_policy(index)
        if is_trained:
            # So that a resumed population does not train this actor again
            for each in self._checkpoints():
                each.save()
        return is_trained

    @classmethod
    def load(
        cls: type[SelfPopulation],
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | str | None = None,
        *args: Any,
        **kwargs: Any,
    ) -> SelfPopulation:
        """
        Load a population from a zip-file, as SB3 does, without a replay buffer until ``learn`` allocates it.

        :param path: path to the file (or a file-like)
        :param env: the environments, one for each agent, or the name of an environment, which is made once for each agent;
            None for predictions alone
        :param args: the further parameters of SB3's ``load``
        :param kwargs: the same by keyword
        :return: the population
        :raises ValueError: if an argument of the agents is given, which a saved population has for each of them, or the file
            holds a single agent
        :raises TypeError: if a population has no such argument or attribute, naming it and the nearest one that is allowed
        """
        for name in {"agents", *OWN, *COMMON} & kwargs.keys():
            require(name in ("verbose", "tensorboard_log"), name, kwargs[name], "left out: change it in a new population")
        path = find_file(cls, path, "zip")
        return super().load(path, cls._make_env(env, path), *args, **kwargs)

    @classmethod
    def _check_saved(cls, saved: Mapping[str, Any]) -> None:
        allowed = f"of {cls.__name__}, a population: load a single agent by its own class, such as `CGP.load(path)`"
        require(not saved or "_agent_updates" in saved, "path", "the file of a single agent", allowed)

    @classmethod
    def _make_env(cls, env: Any, saved: Any) -> Any:
        # A population has as many environments as agents. A file without the number is refused when it is loaded.
        return make_agents_env(env, saved_attributes(saved).get("n_envs", 1)) if isinstance(env, str) else env

    def set_env(self, env: GymEnv | str, force_reset: bool = True) -> None:
        """
        Set the environments of the agents, see SB3's method.

        :param env: the environments, one for each agent, or the name of an environment, which is made once for each agent
        :param force_reset: see SB3's method
        :raises ValueError: if there are more or fewer environments than agents
        """
        envs = make_agents_env(env, len(self))
        # Before SB3, whose error advises to load the population with them
        self._check_n_envs(getattr(envs, "num_envs", 1))
        super().set_env(envs, force_reset)

    def _excluded_save_params(self) -> list[str]:
        made = ["_schedules", "_numbers", "_counts", "_recorded", "_unlogged"]
        return [*super()._excluded_save_params(), *made]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy"], []
