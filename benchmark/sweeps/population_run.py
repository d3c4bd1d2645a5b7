"""
The runs of a group, trained as one population: each in its own folder, which is as it would be if it were trained alone.

The folder of a run that has ended remains as it is, while the run's agent stays in the population.
"""

import math
import shutil
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import gymnasium as gym
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.utils import get_device, set_random_seed
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from benchmark.common.records import EVALUATION_SEED, FINAL_EPISODES
from benchmark.sweeps.agent_experiments import AgentExperiment, ResumedAgent
from benchmark.sweeps.claimed_runs import ClaimedRuns
from benchmark.sweeps.environment_processes import classified_deaths, close_environments
from benchmark.sweeps.groups import Group
from benchmark.sweeps.population_reporter import PopulationReporter
from benchmark.sweeps.run import begin, register_all
from benchmark.sweeps.runs import Run
from benchmark.sweeps.sharing import agent_arguments, ordinary_model
from benchmark.sweeps.zoo_experiments import has_settings, new_experiment, resumed_experiment
from sb3_cgp import RestorableEnv, TrainingCheckpointCallback
from sb3_cgp.population import ChunkedSubprocVecEnv, Population, PopulationEvalCallback, evaluate_population
from sb3_cgp.resumption.store import NoStateLeftError, StateStore
from sb3_cgp.zoo.resumed_run import continue_monitors


def train_group(
    group: Group, folders: Sequence[Path], claimed: ClaimedRuns, watch: Callable[[int], None], device: str = "auto"
) -> dict[int, float]:
    """
    Train a group of runs to their end, from the population's last state if it has one.

    :param group: the group
    :param folders: the folder of each run
    :param claimed: receives the evaluations and the failures of the runs
    :param watch: receives the environment steps of each run at every step, and may raise
    :param device: device of the networks
    :return: of the runs that have not failed, by their index, mean return of the final model over episodes that are the same
        for all runs of a task
    :raises FileExistsError: if a folder holds a run on another environment
    """
    group.write()
    for run, folder in zip(group.runs, folders, strict=True):
        register_all(run)
        begin(run, folder)
    with ExitStack() as environments, classified_deaths(group.folder):
        try:
            experiments, population = _set_up(group, folders, claimed, device, environments)
        except NoStateLeftError as error:
            print(f"Population {group.folder.name} starts from the beginning: {error}", flush=True)
            shutil.rmtree(group.states)
            experiments, population = _set_up(group, folders, claimed, device, environments)
        first = group.runs[0]
        evaluation = PopulationEvalCallback(
            _join(group, experiments, device, environments),
            n_eval_episodes=first.evaluation_episodes,
            eval_freq=first.evaluation_interval,
            verbose=0,
        )
        # The reporter is the last one: where no step is left, the callback before it restores the evaluations
        reporter = PopulationReporter(group.runs, folders, evaluation, claimed, watch)
        saving = TrainingCheckpointCallback(len(group.runs) * first.checkpoint_interval, group.states, keep=1)
        try:
            population.learn(len(group.runs) * first.steps, callback=[evaluation, saving, reporter])
            # Those of offline training, too
            reporter.report_failures()
            return _finish(group, experiments, population, evaluation.eval_env, claimed)
        except ValueError:
            # Raised when all agents have failed
            reporter.report_failures()
            if len(population.failed) < len(population):
                raise
            return {}


def _set_up(
    group: Group, folders: Sequence[Path], claimed: ClaimedRuns, device: str, environments: ExitStack
) -> tuple[list[AgentExperiment], Population]:
    """Return rl_zoo3's manager of each run, and the population, which starts or continues."""
    runs = group.runs
    continues = bool(StateStore(group.states).steps())
    experiments = [_experiment(run, folder, device, continues) for run, folder in zip(runs, folders, strict=True)]
    set_random_seed(runs[0].seed)
    for experiment in experiments:
        experiment.setup_experiment()
    are_open = [claimed.is_open(run) for run in runs]
    env = _join(group, experiments, device, environments, are_open)
    if continues:
        population = Population.resume(group.states, env, device=device)
        assert population.resumption is not None
        monitors = [folder / f"0.{Monitor.EXT}" if log else None for folder, log in zip(folders, are_open, strict=True)]
        continue_monitors(monitors, env, population.num_timesteps, population.resumption["environment"])
        return experiments, population
    arguments = [
        agent_arguments(run.algo, experiment.arguments) | {"seed": run.seed}
        for run, experiment in zip(runs, experiments, strict=True)
    ]
    return experiments, Population("MlpPolicy", env, arguments, device=device)


def _experiment(run: Run, folder: Path, device: str, continues: bool) -> AgentExperiment:
    # The states are not in the run's folder, which a user may have removed after the run's end
    if continues and has_settings(folder):
        return resumed_experiment(ResumedAgent, run, folder, device)
    return new_experiment(AgentExperiment, run, folder, device)


def _join(
    group: Group, experiments: Sequence[AgentExperiment], device: str, environments: ExitStack, logged: Sequence[bool] = ()
) -> VecEnv:
    """
    Return the environments of all runs, each made by rl_zoo3's manager of its run, and seeded as it would seed them.

    The stack closes them. Whether the episodes of each run are logged is given for those of the training only.
    """
    makers: list[Callable[[], gym.Env]] = [
        partial(_make_env, run, experiment, not logged, not (logged and logged[index]))
        for index, (run, experiment) in enumerate(zip(group.runs, experiments, strict=True))
    ]
    # On a CPU, the simulators would take the cores of the gradient steps
    env: VecEnv = ChunkedSubprocVecEnv(makers) if get_device(device).type == "cuda" else DummyVecEnv(makers)
    environments.callback(close_environments, env)
    _seed(env, [run.seed for run in group.runs])
    return env


def _make_env(run: Run, experiment: AgentExperiment, eval_env: bool, no_log: bool) -> gym.Env:
    """Make the environment of a run, also in another process."""
    register_all(run)
    env = experiment.create_envs(1, eval_env, no_log)
    assert isinstance(env, DummyVecEnv)
    return RestorableEnv(env.envs[0])


def _seed(env: VecEnv, seeds: Sequence[int]) -> None:
    # SB3 counts the environments' seeds from one number
    env._seeds = list(seeds)


def _finish(
    group: Group, experiments: Sequence[AgentExperiment], population: Population, env: VecEnv, claimed: ClaimedRuns
) -> dict[int, float]:
    """Save the models of the runs that have not failed, and return their final returns."""
    healthy = [index for index, run in enumerate(group.runs) if claimed.is_open(run)]
    for index in healthy:
        experiment = experiments[index]
        experiment.save_trained_model(ordinary_model(group.runs[index], experiment.arguments, population[index]))
    if not healthy:
        return {}
    _seed(env, [EVALUATION_SEED] * len(group.runs))
    finals = evaluate_population(population, env, FINAL_EPISODES)[0].mean(axis=1)
    for index in healthy:
        if not math.isfinite(finals[index]):
            claimed.fail(group.runs[index], FloatingPointError(f"The final model's mean return is {finals[index]}"))
    return {index: float(finals[index]) for index in healthy if claimed.is_open(group.runs[index])}
