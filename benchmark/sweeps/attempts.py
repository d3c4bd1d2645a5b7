"""Attempts at a run or a configuration: which errors count against it, and when it is given up."""

import errno
from collections.abc import Iterable

import torch as th
from optuna.trial import FrozenTrial, TrialState

from benchmark.sweeps.heartbeats import PROGRESS
from benchmark.sweeps.storages import StorageError
from benchmark.sweeps.study_trials import LOST, OUTCOME, STOPPED
from benchmark.sweeps.tuning import SCORES

# The beginnings of outcomes: of a trial that an error ended which may be the machine's, and of one in a population that an
# error ended which may be another run's
SUSPECT, DISSOLVED = "given back after an error: ", "dissolved: "
# Attempts one after another without progress after which a run is given up
MAX_FRUITLESS_ATTEMPTS = 3
# Errors that every run of the machine would have
OF_ALL_RUNS = (StorageError, th.AcceleratorError)
# Of a disk that is full, read-only, broken or gone, and of too many open files
SYSTEM_ERRORS = (
    *(errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO, errno.ESTALE, errno.ENODEV, errno.ENXIO),
    *(errno.EMFILE, errno.ENFILE),
)


def in_words(error: BaseException) -> str:
    """
    Return an error as records have it.

    :param error: the error
    :return: its class and its text
    """
    return f"{type(error).__name__}: {error}"


def outcome_of(error: Exception) -> str:
    """
    Return the outcome of a trial that an error of the machine has ended.

    :param error: the error
    :return: the outcome, which counts against the run unless every run would have the error
    """
    is_of_all = isinstance(error, OF_ALL_RUNS) or getattr(error, "errno", None) in SYSTEM_ERRORS
    return STOPPED if is_of_all else SUSPECT + in_words(error)


def ended_by_error(attempts: Iterable[FrozenTrial]) -> bool:
    """
    Return whether the last attempt that has ended was ended by a suspected error.

    :param attempts: the trials of a run, in their order
    :return: whether another one may end its process, too
    """
    outcomes = [trial.user_attrs[OUTCOME] for trial in attempts if OUTCOME in trial.user_attrs]
    return bool(outcomes) and outcomes[-1].startswith(SUSPECT)


def fruitless(attempts: Iterable[FrozenTrial]) -> int:
    """
    Count the last attempts that got no further than those before.

    :param attempts: the trials of a run or a configuration, in their order
    :return: the number of trials that run now, were lost or were ended by a suspected error, since the last one with progress
    """
    count, furthest = 0, (0, 0)
    for trial in attempts:
        outcome = trial.user_attrs.get(OUTCOME, "")
        reached = len(trial.user_attrs.get(SCORES, [])), trial.user_attrs.get(PROGRESS, {}).get("step", 0)
        if outcome.startswith(DISSOLVED):
            # The run begins anew, alone
            count, furthest = 0, (0, 0)
        elif reached > furthest:
            count, furthest = 0, reached
        elif trial.state is TrialState.RUNNING or outcome == LOST or outcome.startswith(SUSPECT):
            count += 1
    return count
