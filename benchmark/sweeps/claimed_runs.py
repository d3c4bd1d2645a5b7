"""The runs that a process has taken together, until each of them has ended: their heartbeats, reports and ends."""

import threading
from collections.abc import Sequence
from typing import Any

from benchmark.sweeps.attempts import DISSOLVED, MAX_FRUITLESS_ATTEMPTS, in_words, outcome_of
from benchmark.sweeps.heartbeats import TrialLostError
from benchmark.sweeps.runs import Run
from benchmark.sweeps.studies import Ledger
from benchmark.sweeps.study_trials import STOPPED, Claim


class ClaimedRuns:
    """
    The runs that a process trains: one, or some of the agents of a population.

    :param ledger: the study
    :param claims: the runs
    :param n_agents: number of agents that share the process's time on the processor
    """

    def __init__(self, ledger: Ledger, claims: Sequence[Claim], n_agents: int):
        self._ledger, self._n_agents = ledger, n_agents
        # By key, those that have not ended
        self._open = {claim.run.key: claim for claim in claims}
        # The thread of the heartbeats must not find a trial that the main thread has just ended
        self._lock = threading.Lock()

    @property
    def has_open(self) -> bool:
        """Whether some run has not ended."""
        return len(self._open) > 0

    def is_open(self, run: Run) -> bool:
        """
        Return whether this process has taken a run, and has not ended it.

        :param run: the run
        :return: whether its results are recorded
        """
        return run.key in self._open

    def beat(self, count: str, step: int, seconds: float, processor_seconds: float = 0.0) -> None:
        """
        Report that this process is alive, and the progress of its runs.

        :param count: a text that no earlier heartbeat had
        :param step: environment steps of each run so far
        :param seconds: wall-clock time of this attempt so far
        :param processor_seconds: the process's time on the processor, of all threads together, which the agents share
        :raises TrialLostError: if another process has ended a trial
        """
        with self._lock:
            for claim in self._open.values():
                self._ledger.beat(claim, count, step, seconds, processor_seconds / self._n_agents)

    def annotate(self, name: str, value: Any) -> None:
        """
        Set an attribute of all open runs' trials.

        :param name: the attribute
        :param value: its value, as JSON has it
        :raises TrialLostError: if another process has ended a trial
        """
        with self._lock:
            for claim in self._open.values():
                self._ledger.annotate(claim, name, value)

    def note_continuation(self) -> None:
        """
        Note that all open runs go on from a state, unless earlier trials of this study have left it.

        :raises TrialLostError: if another process has ended a trial
        """
        with self._lock:
            for claim in self._open.values():
                self._ledger.note_continuation(claim)

    def report(self, run: Run, step: int, value: float) -> None:
        """
        Record an evaluation, of a run that is open.

        :param run: the run
        :param step: environment steps
        :param value: mean return
        :raises TrialLostError: if another process has ended the trial
        """
        if self.is_open(run):
            self._ledger.report(self._open[run.key], step, value)

    def fail(self, run: Run, error: BaseException) -> None:
        """
        End a run that failed for its own reasons, if it is open.

        :param run: the run
        :param error: the error
        """
        with self._lock:
            if self.is_open(run):
                self._ledger.fail(self._open[run.key], error)
                del self._open[run.key]

    def complete(self, run: Run, value: float) -> bool:
        """
        End a run, if it is open.

        :param run: the run
        :param value: mean return of the final model
        :return: whether it has ended as this process says; False if another process has ended the trial before
        """
        with self._lock:
            is_lost = False
            if self.is_open(run):
                try:
                    self._ledger.complete(self._open[run.key], value)
                except TrialLostError:
                    is_lost = True
                del self._open[run.key]
        return not is_lost

    def is_held(self) -> bool:
        """
        Return whether no other process has ended an open run, which it may then have given to another one.

        :return: whether all open runs are still this process's own
        """
        return all(self._ledger.holds(claim) for claim in self._open.values())

    def release(self, outcome: str = STOPPED) -> None:
        """
        Give back all open runs, to be continued by any process.

        :param outcome: the reason, for people
        """
        with self._lock:
            while self._open:
                self._ledger.release(self._open.popitem()[1], outcome)

    def is_stuck(self, error: Exception) -> bool:
        """
        Return whether an error of the machine has ended an open run again and again, at no later step.

        :param error: the error
        :return: whether it is to be taken for an error of the run's own; never for one that every run would have
        """
        return outcome_of(error) != STOPPED and any(
            self._ledger.fruitless(claim) >= MAX_FRUITLESS_ATTEMPTS for claim in self._open.values()
        )

    def dissolve(self, error: BaseException) -> None:
        """
        Give back all open runs, to be trained one by one.

        :param error: the error of the population
        """
        self.release(DISSOLVED + in_words(error))
