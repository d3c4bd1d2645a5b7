"""How a process that works on a trial is known to be alive: by a heartbeat among the trial's attributes."""

import os
import signal
import threading
import time
from collections.abc import Callable, Iterable
from typing import Any

from optuna.exceptions import UpdateFinishedTrialError
from optuna.storages import BaseStorage
from optuna.trial import FrozenTrial, TrialState

from benchmark.sweeps.storages import patiently

# Seconds between two heartbeats, and until a silent process is given up, by default
BEAT, GRACE = 5.0, 60.0
# Seconds between two looks after which the looker does not trust the silence, if the grace is short
LONGEST_ABSENCE = 10.0

# The attribute of a trial that changes while its process is alive
PROGRESS = "progress"


class TrialLostError(RuntimeError):
    """This process was given up by another: the trial is not its own any more."""


def send_beat(storage: BaseStorage, trial_id: int, count: str, step: int, seconds: float) -> None:
    """
    Say that this process is alive, and how far its trial is.

    :param storage: where the trial is
    :param trial_id: the trial
    :param count: what has not been said yet
    :param step: environment steps so far
    :param seconds: what this attempt has taken so far
    :raises TrialLostError: if the trial is not this process's any more
    """
    progress = {"beat": count, "step": step, "seconds": round(seconds, 1)}
    try:
        patiently(storage.set_trial_user_attr, trial_id, PROGRESS, progress)
    except UpdateFinishedTrialError as error:
        raise TrialLostError(f"trial {trial_id}") from error


class Heart:
    """
    A thread that tells a study, again and again, that this process is alive, and sees whether it should be.

    :param beat: tells it: takes what has not been said yet, environment steps so far, and seconds so far
    :param interval: seconds between two beats
    :param parent: the process that started this one; when it is gone, this one is to end. None for no such process
    """

    def __init__(self, beat: Callable[[str, int, float], None], interval: float, parent: int | None = None):
        self._tell, self._interval, self._parent = beat, interval, parent
        self._start = time.monotonic()
        self._step = 0
        self._has_ended = threading.Event()
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> "Heart":
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._has_ended.set()
        self._thread.join()

    def watch(self, step: int) -> None:
        """
        Note how far the run is.

        :param step: environment steps
        :raises TrialLostError: if the run is not this process's any more
        """
        self._step = step
        if self._error is not None:
            raise self._error

    def _run(self) -> None:
        beat = 0
        while self._error is None:
            try:
                self._tell(f"{os.getpid()}-{beat}", self._step, time.monotonic() - self._start)
            except Exception as error:
                self._error = error
            if self._parent is not None and os.getppid() != self._parent:
                os.kill(os.getpid(), signal.SIGTERM)
                return
            beat += 1
            if self._has_ended.wait(self._interval):
                break
        # The last word on what it took
        if self._error is None:
            try:
                self._tell(f"{os.getpid()}-end", self._step, time.monotonic() - self._start)
            except Exception as error:
                self._error = error


class Silence:
    """
    Finds trials whose processes have fallen silent.

    A looker that was away itself, as while the database was, counts from its return: the others had no way to be heard.

    :param grace: seconds of silence after which a process is taken for lost
    :param clock: tells seconds
    """

    def __init__(self, grace: float, clock: Callable[[], float] = time.monotonic):
        self._grace = grace
        self._clock = clock
        # By trial, the heartbeat that was seen last, and when it was first seen
        self._seen: dict[int, tuple[Any, float]] = {}
        self._last_look: float | None = None

    def find(self, trials: Iterable[FrozenTrial]) -> list[FrozenTrial]:
        """
        Look at a study's trials.

        :param trials: the trials
        :return: those that run, and whose heartbeat has stood still in all looks for longer than the grace
        """
        now = self._clock()
        if self._last_look is not None and now - self._last_look > max(self._grace / 2, LONGEST_ABSENCE):
            self._seen = {}
        self._last_look = now
        silent = []
        for trial in trials:
            if trial.state is TrialState.RUNNING:
                beat = trial.user_attrs.get(PROGRESS)
                seen, since = self._seen.setdefault(trial.number, (beat, now))
                if seen != beat:
                    self._seen[trial.number] = beat, now
                elif now - since > self._grace:
                    silent.append(trial)
        return silent
