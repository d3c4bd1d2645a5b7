"""How a process that works on a trial is known to be alive: by a heartbeat among the trial's attributes."""

import time
from collections.abc import Callable, Iterable
from typing import Any

from optuna.trial import FrozenTrial, TrialState

# The attribute of a trial that changes while its process is alive
PROGRESS = "progress"


class Silence:
    """
    Finds trials whose processes have fallen silent.

    :param grace: seconds of silence after which a process is taken for lost
    :param clock: tells seconds
    """

    def __init__(self, grace: float, clock: Callable[[], float] = time.monotonic):
        self._grace = grace
        self._clock = clock
        # By trial, the heartbeat that was seen last, and when it was first seen
        self._seen: dict[int, tuple[Any, float]] = {}

    def find(self, trials: Iterable[FrozenTrial]) -> list[FrozenTrial]:
        """
        Look at a study's trials.

        :param trials: the trials
        :return: those that run, and whose heartbeat has stood still since a look that is long ago
        """
        now = self._clock()
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
