"""Checks of values before the first run starts: each configuration has to become a model."""

import argparse
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import optuna
import yaml
from optuna.samplers import RandomSampler
from rl_zoo3 import ALGOS
from rl_zoo3.exp_manager import ExperimentManager
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from benchmark.common.zoo import random_steps, silence
from benchmark.sweeps.attempts import in_words
from benchmark.sweeps.experiments import Sweep
from benchmark.sweeps.hyperparameters import problems
from benchmark.sweeps.runs import Run
from benchmark.sweeps.tuning import Tuning
from benchmark.sweeps.validation import SweepError

# A replay buffer that is only constructed needs no more memory than this
LARGEST_BUFFER = 10_000
# Configurations of a tuning that are tried, of which one has to become a model
N_SAMPLES = 10


def check_values(sweep: Sweep) -> None:
    """
    Construct a model of each configuration, as values may be wrong that have the right names and types, and warn of runs that
    learn nothing, or that are longer than the others.

    :param sweep: the sweep
    :raises SweepError: if a model cannot be constructed; it names the sweep's file, the configuration and the error
    """
    found: dict[str, None] = {}
    for run in _representatives(sweep):
        try:
            model = construct(run)
        except Exception as error:
            place = f"{run.configuration} on {run.task}"
            raise SweepError(sweep.path or sweep.name, place, f"no model can be made: {in_words(error)}") from error
        found |= dict.fromkeys(_doubts(run, model))
    for doubt in found:
        print(f"Warning: {sweep.path or sweep.name}: {doubt}", file=sys.stderr)


def _doubts(run: Run, model: BaseAlgorithm) -> Iterator[str]:
    """List what a run's length and its hyperparameters make of it that its results would not show."""
    starts = random_steps(run.algo, run.hyperparams)
    if starts >= run.steps:
        yield f"{run.method} learns nothing, as all of its {run.steps:,} steps are random (learning_starts={starts})"
    if isinstance(model, OnPolicyAlgorithm):
        between = model.n_steps * model.n_envs
        if surplus := -run.steps % between:
            yield (
                f"{run.method} trains for {run.steps + surplus:,} steps in place of {run.steps:,}, as {between:,} are "
                "between its updates; its final returns are those after all of them. To avoid it, set n_steps, or steps that "
                f"are a multiple of {between}"
            )


def check_tuning(tuning: Tuning) -> None:
    """
    Check that some sampled configuration becomes a model, with the task's entry and the hyperparameters that are fixed, and
    warn if others do not.

    :param tuning: the tuning
    :raises SweepError: if none of several does; it names the first one's error
    """
    study = optuna.create_study(sampler=RandomSampler(seed=0))
    errors: list[Exception] = []
    for _ in range(N_SAMPLES):
        trial = study.ask()
        tuning.sample(trial)
        run = tuning.run(study.trials[trial.number], seed=0)
        hyperparams = {name: value for name, value in run.hyperparams.items() if name != "n_timesteps"}
        for key, problem in problems("the tuned method", run.algo, hyperparams):
            raise SweepError("The tuned configurations", key, problem)
        try:
            construct(run)
        except Exception as error:
            errors.append(error)
    if len(errors) == N_SAMPLES:
        raise SweepError("The tuned configurations", "", f"no model can be made: {in_words(errors[0])}") from errors[0]
    if errors:
        print(
            f"Warning: of {N_SAMPLES} sampled configurations, {len(errors)} cannot be trained ({in_words(errors[0])}). "
            "Trials of these fail, and count for --trials: to avoid them, set the hyperparameter that contradicts by --set",
            file=sys.stderr,
        )


def _representatives(sweep: Sweep) -> Iterator[Run]:
    """List a run of each configuration on the first task, and a run of each method on all other tasks."""
    seen: set[tuple[str, str]] = set()
    for run in sweep.runs():
        part = run.configuration if run.task == sweep.file.tasks[0] else run.method
        if (run.task, part) not in seen:
            seen.add((run.task, part))
            yield run


def construct(run: Run) -> BaseAlgorithm:
    """
    Construct the model of a run as rl_zoo3 does, without training it.

    :param run: the run, whose environment is registered
    :return: the model, whose environments are closed
    :raises Exception: all errors of the environment and the algorithm
    """
    hyperparams: dict[str, Any] = {"n_timesteps": run.steps, **run.hyperparams}
    if issubclass(ALGOS[run.algo], OffPolicyAlgorithm) and isinstance(hyperparams.get("buffer_size", 0), int):
        hyperparams["buffer_size"] = min(hyperparams.get("buffer_size", LARGEST_BUFFER), LARGEST_BUFFER)
    with TemporaryDirectory() as folder, silence(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        conf_file = Path(folder) / "hyperparams.yml"
        conf_file.write_text(yaml.safe_dump({run.task: hyperparams}))
        manager = ExperimentManager(
            argparse.Namespace(),
            run.algo,
            run.task,
            folder,
            n_timesteps=run.steps,
            eval_freq=-1,
            config=str(conf_file),
            seed=run.seed,
            verbose=0,
            device="cpu",
        )
        model, _ = manager.setup_experiment()  # type: ignore[misc]
        assert model.env is not None
        model.env.close()
        return model
