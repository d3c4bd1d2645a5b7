"""A tuning: its settings, and the runs of the configurations that rl_zoo3's samplers suggest."""

from dataclasses import dataclass

import gymnasium as gym
import optuna
from gymnasium import spaces
from optuna.trial import FrozenTrial
from rl_zoo3.hyperparams_opt import HYPERPARAMS_SAMPLER

from benchmark.sweeps.entries import sampled_entry
from benchmark.sweeps.runs import Run
from benchmark.sweeps.sweep_files import Hyperparams

# Attributes of a trial: the scores of its seeds so far, and the number of its configuration's first trial
SCORES, ORIGIN = "scores", "origin"


@dataclass(frozen=True)
class Tuning:
    """
    The settings of a tuning.

    :param algo: the algorithm's name in rl_zoo3
    :param task: the environment, as it is registered
    :param base: the task's entry before any hyperparameter is sampled
    :param fixed: hyperparameters that replace sampled ones
    :param steps: environment steps of each run
    :param seeds: runs of each configuration, with seeds from 0
    :param score: the statistic of the seeds' final returns, a key of ``SCORING``
    :param pruner: the rule for giving a configuration up, a key of ``PRUNERS``
    :param evaluation_interval: environment steps between two evaluations
    :param evaluation_episodes: episodes of each evaluation
    :param checkpoint_interval: environment steps between two saved training states
    :param gym_packages: modules to import, which register the environment
    """

    algo: str
    task: str
    base: Hyperparams
    fixed: Hyperparams
    steps: int
    seeds: int
    score: str
    pruner: str
    evaluation_interval: int
    evaluation_episodes: int
    checkpoint_interval: int
    gym_packages: list[str]

    def sample(self, trial: optuna.Trial) -> None:
        """
        Suggest hyperparameters.

        :param trial: the trial, which stores them
        """
        env = gym.make(self.task, **({**self.base, **self.fixed}.get("env_kwargs") or {}))
        n_actions = env.action_space.shape[0] if isinstance(env.action_space, spaces.Box) else 0
        env.close()
        uses_her = "HerReplayBuffer" in str(self.base.get("replay_buffer_class"))
        # Only CGP's sampler looks at the fixed ones
        additional_args = {"using_her_replay_buffer": uses_her, "her_kwargs": {}, "fixed": self.fixed}
        HYPERPARAMS_SAMPLER[self.algo](trial, n_actions, self.base.get("n_envs", 1), additional_args)

    def entry(self, trial: FrozenTrial) -> Hyperparams:
        """
        Return the hyperparameters of a trial.

        :param trial: the trial
        :return: an entry of rl_zoo3's YAML files
        """
        return {**sampled_entry(self.algo, self.base, trial.params, self.fixed), "n_timesteps": self.steps}

    def run(self, trial: FrozenTrial, seed: int) -> Run:
        """
        Return a run of a trial's configuration.

        :param trial: the trial
        :param seed: the seed
        :return: the run, whose folder later trials of the same configuration share
        """
        return Run(
            f"trial-{trial.user_attrs.get(ORIGIN, trial.number)}",
            self.task,
            {},
            seed,
            self.algo,
            self.entry(trial),
            self.steps,
            self.evaluation_interval,
            self.evaluation_episodes,
            self.checkpoint_interval,
            self.gym_packages,
        )
