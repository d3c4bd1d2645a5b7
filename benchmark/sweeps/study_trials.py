"""The trials of a study: the attributes that describe a run, and the rule which of a run's trials is its own."""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from optuna.distributions import BaseDistribution, CategoricalDistribution
from optuna.trial import FrozenTrial, TrialState

from benchmark.common.records import Record
from benchmark.sweeps.experiments import Sweep
from benchmark.sweeps.heartbeats import PROGRESS
from benchmark.sweeps.runs import Run

# Attributes of a study: its description, and the prefix of those that each record a command that trained runs
SWEEP, COMMAND = "sweep", "command "
# The key of a description with what all methods have in common; studies of earlier versions lack it
SHARED = "shared"
# The attribute of a tuning's study, which has other trials: its settings
TUNING = "tuning"
# Attributes of a trial
RUN, KEY, ERROR, WORKER, OUTCOME = "run", "key", "error", "worker", "outcome"
# Outcomes of trials whose run or configuration is to be continued
STOPPED, LOST = "given back: its process was stopped", "lost: its process fell silent"
# A list: the processor on which this trial was trained; of an adopted run, all that trained it
PROCESSORS = "processors"
# Of a run that is trained in a population: the number of its agents, and the name of the group of runs
POPULATION = "population"
# Of a trial that goes on from a state that another storage's trial has left: the time until then is not known
CONTINUED = "continued"
# The seed is an attribute, for optuna-dashboard to show and sort by. As a parameter, it would take part in the importances of
# parameters.
SEED = "seed"


@dataclass(frozen=True)
class Claim:
    """
    A run that this process has taken.

    :param trial_id: the trial
    :param run: the run
    """

    trial_id: int
    run: Run


def is_open_or_ended(trial: FrozenTrial) -> bool:
    """
    Return whether a run with this trial needs no other trial.

    :param trial: the trial
    :return: whether it waits, runs, is completed, or has failed with an error
    """
    return trial.state is not TrialState.FAIL or ERROR in trial.user_attrs


def run_of(trial: FrozenTrial) -> Run:
    """
    Return the run of a trial.

    :param trial: the trial
    :return: the run
    :raises SweepError: if another version of sb3-cgp described it, by other fields
    """
    return Run.from_fields(trial.user_attrs[RUN], f"Trial {trial.number} of the study")


def owned(trials: Iterable[FrozenTrial]) -> dict[str, FrozenTrial]:
    """
    Return the trial of each run.

    :param trials: the study's trials
    :return: by the run's key, its first trial for which :func:`is_open_or_ended` is true
    """
    owners: dict[str, FrozenTrial] = {}
    for trial in sorted(trials, key=lambda trial: trial.number):
        if is_open_or_ended(trial):
            owners.setdefault(trial.user_attrs[KEY], trial)
    return owners


def attributes_of(run: Run) -> dict[str, Any]:
    """
    Return the attributes of a run's trials.

    :param run: the run
    :return: its key, which is its name in optuna-dashboard, its seed, and all of its fields
    """
    return {KEY: run.key, SEED: run.seed, RUN: asdict(run)}


def seconds_of(trials: Iterable[FrozenTrial], kind: str) -> float | None:
    """
    Return the time that a run took.

    :param trials: all trials of the run
    :param kind: "seconds" by the clock, or "processor_seconds"
    :return: the sum of what their last heartbeats reported; None if one of them has reported progress, but not this time, or
        went on from a state of another storage
    """
    trials = list(trials)
    if any(CONTINUED in trial.user_attrs for trial in trials):
        return None
    times = [trial.user_attrs[PROGRESS].get(kind) for trial in trials if PROGRESS in trial.user_attrs]
    return None if None in times else sum(times)


def processors_of(trials: Iterable[FrozenTrial]) -> list[str]:
    """
    Return the processors on which a run was trained.

    :param trials: all trials of the run
    :return: their names; none if one of the trials has reported progress, but not its processor
    """
    named = [trial.user_attrs.get(PROCESSORS, []) for trial in trials if PROGRESS in trial.user_attrs]
    return sorted({name for names in named for name in names}) if all(named) else []


def params_of(run: Run) -> dict[str, Any]:
    """
    Return Optuna's parameters of a run.

    :param run: the run
    :return: method, task and the values of the axes
    """
    return {"method": run.method, "task": run.task, **run.settings}


def distributions_of(sweep: Sweep) -> dict[str, BaseDistribution]:
    """
    Return Optuna's distributions of the parameters of a sweep's runs.

    :param sweep: the sweep
    :return: distribution by parameter; those of the file, as a later command may add methods
    """
    choices: dict[str, list[Any]] = {"method": list(sweep.file.methods), "task": sweep.file.tasks}
    choices |= {name: list(axis.values) for name, axis in sweep.file.axes.items()}
    return {name: CategoricalDistribution(values) for name, values in choices.items()}


def choices_of(trials: Sequence[FrozenTrial], name: str) -> list[Any]:
    """
    Return the values that a parameter can have in a study.

    :param trials: the study's trials
    :param name: the parameter
    :return: the values; none without a trial
    """
    distribution = trials[0].distributions[name] if trials else None
    return list(distribution.choices) if isinstance(distribution, CategoricalDistribution) else []


def record_of(experiment: str, trial: FrozenTrial, trials: Iterable[FrozenTrial]) -> Record:
    """
    Return the record of a run that has ended.

    :param experiment: the sweep's name
    :param trial: the run's own trial
    :param trials: all trials of the run
    :return: the record
    """
    trials = list(trials)
    run, points = trial.user_attrs[RUN], sorted(trial.intermediate_values.items())
    return Record(
        experiment,
        run["method"],
        run["task"],
        run["settings"],
        run["seed"],
        run["steps"],
        [step for step, _ in points],
        [value for _, value in points],
        trial.value if trial.state is TrialState.COMPLETE else None,
        trial.user_attrs.get(ERROR),
        seconds_of(trials, "seconds"),
        seconds_of(trials, "processor_seconds"),
        trial.user_attrs.get(POPULATION, {}).get("agents", 1),
        processors_of(trials),
    )
