"""Heartbeats among the attributes of trials, by which other processes know that a trial's process is alive."""

import os
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from optuna.exceptions import UpdateFinishedTrialError
from optuna.storages import BaseStorage
from optuna.trial import FrozenTrial, TrialState

from benchmark.sweeps.signals import end_if_asked

# Defaults: seconds between two heartbeats, and seconds of silence after which a process is taken for lost
BEAT, GRACE = 5.0, 60.0
# Seconds between two searches after which silence is not trusted, if the grace period is short
LONGEST_ABSENCE = 10.0

# The attribute of a trial that changes as long as its process is alive
PROGRESS = "progress"


class TrialLostError(RuntimeError):
    """Another process has ended this process's trial."""


@contextmanager
def noticing_loss(name: str) -> Iterator[None]:
    """
    Report within a ``with`` block that another process has ended the trial to which the block writes.

    :param name: the trial, or its run, in the error's message
    :raises TrialLostError: if another process has ended the trial
    """
    try:
        yield
    except UpdateFinishedTrialError as error:
        raise TrialLostError(name) from error


def send_beat(
    storage: BaseStorage, trial_id: int, count: str, step: int, seconds: float, processor_seconds: float = 0.0
) -> None:
    """
    Report that this process is alive, and the progress of its trial.

    :param storage: the storage of the trial
    :param trial_id: the trial
    :param count: a text that no earlier heartbeat had
    :param step: environment steps so far
    :param seconds: wall-clock time of this attempt so far
    :param processor_seconds: its time on the processor, of all threads together
    :raises TrialLostError: if another process has ended the trial
    """
    progress = {"beat": count, "step": step, "seconds": round(seconds, 1), "processor_seconds": round(processor_seconds, 1)}
    with noticing_loss(f"trial {trial_id}"):
        storage.set_trial_user_attr(trial_id, PROGRESS, progress)


class HeartbeatThread:
    """
    A thread that reports at intervals that this process is alive, and ends the process with its parent.

    :param beat: sends a heartbeat; takes a text that no earlier one had, environment steps, and seconds so far by the clock
        and on the processor
    :param interval: seconds between two heartbeats
    :param parent: the process that started this one, whose end is this one's, too; None for no such process
    """

    def __init__(self, beat: Callable[[str, int, float, float], None], interval: float, parent: int | None = None):
        self._send, self._interval, self._parent = beat, interval, parent
        self._start, self._processor_start = time.monotonic(), time.process_time()
        self._step = 0
        self._has_ended = threading.Event()
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> "HeartbeatThread":
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._has_ended.set()
        self._thread.join()

    def watch(self, step: int) -> None:
        """
        Set the progress of the run.

        :param step: environment steps
        :raises TrialLostError: if another process has ended the trial
        :raises SystemExit: if a signal has asked the process to end
        """
        self._step = step
        end_if_asked()
        if self._error is not None:
            raise self._error

    def _spent(self) -> tuple[float, float]:
        return time.monotonic() - self._start, time.process_time() - self._processor_start

    def _run(self) -> None:
        beat = 0
        while self._error is None:
            try:
                self._send(f"{os.getpid()}-{beat}", self._step, *self._spent())
            except Exception as error:
                self._error = error
            if self._parent is not None and os.getppid() != self._parent:
                os.kill(os.getpid(), signal.SIGTERM)
                return
            beat += 1
            if self._has_ended.wait(self._interval):
                break
        # The time in all
        if self._error is None:
            try:
                self._send(f"{os.getpid()}-end", self._step, *self._spent())
            except Exception as error:
                self._error = error


class SilenceDetector:
    """
    Finds trials whose processes have sent no heartbeat for longer than the grace period.

    After a pause between two searches, as while the database did not answer, silence counts anew: other processes could not
    report either.

    :param grace: seconds of silence after which a process is taken for lost
    :param clock: returns seconds
    """

    def __init__(self, grace: float, clock: Callable[[], float] = time.monotonic):
        self._grace = grace
        self._clock = clock
        # By trial, the last heartbeat, and the time when it was first read
        self._seen: dict[int, tuple[Any, float]] = {}
        self._last_search: float | None = None

    def find(self, trials: Iterable[FrozenTrial]) -> list[FrozenTrial]:
        """
        Return the trials of processes that have fallen silent.

        :param trials: a study's trials
        :return: those that run, and whose heartbeat has been the same in all searches for longer than the grace period
        """
        now = self._clock()
        if self._last_search is not None and now - self._last_search > max(self._grace / 2, LONGEST_ABSENCE):
            self._seen = {}
        self._last_search = now
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
