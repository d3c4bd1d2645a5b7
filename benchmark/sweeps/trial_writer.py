"""Writing a study's trials: a process takes them, reports on them, and ends them."""

from typing import Any

from optuna.exceptions import UpdateFinishedTrialError
from optuna.trial import FrozenTrial, TrialState

from benchmark.sweeps.attempts import fruitless, in_words
from benchmark.sweeps.heartbeats import PROGRESS, TrialLostError, noticing_loss, send_beat
from benchmark.sweeps.study_trials import CONTINUED, ERROR, KEY, OUTCOME, Claim
from benchmark.sweeps.study_view import StudyView


class TrialWriter(StudyView):
    """
    A study whose trials this process takes and ends.

    :param storage: the storage of the study
    :param name: the study's name
    """

    def _take(self, trial_id: int) -> bool:
        try:
            return self.storage.set_trial_state_values(trial_id, TrialState.RUNNING)
        except UpdateFinishedTrialError:
            return False

    def beat(self, claim: Claim, count: str, step: int, seconds: float, processor_seconds: float = 0.0) -> None:
        """
        Report that this process is alive, and the progress of the run.

        :param claim: the run
        :param count: a text that no earlier heartbeat had
        :param step: environment steps so far
        :param seconds: wall-clock time of this attempt so far
        :param processor_seconds: its time on the processor, of all threads together
        :raises TrialLostError: if another process has ended the trial
        """
        send_beat(self.storage, claim.trial_id, count, step, seconds, processor_seconds)

    def annotate(self, claim: Claim, name: str, value: Any) -> None:
        """
        Set an attribute of a run's trial.

        :param claim: the run
        :param name: the attribute
        :param value: its value, as JSON has it
        :raises TrialLostError: if another process has ended the trial
        """
        with noticing_loss(claim.run.key):
            self.storage.set_trial_user_attr(claim.trial_id, name, value)

    def report(self, claim: Claim, step: int, value: float) -> None:
        """
        Record an evaluation.

        :param claim: the run
        :param step: environment steps
        :param value: mean return
        :raises TrialLostError: if another process has ended the trial
        """
        with noticing_loss(claim.run.key):
            self.storage.set_trial_intermediate_value(claim.trial_id, step, value)

    def complete(self, claim: Claim, value: float) -> None:
        """
        End a run.

        :param claim: the run
        :param value: mean return of the final model
        :raises TrialLostError: if another process has ended the trial
        """
        self._end(claim.trial_id, TrialState.COMPLETE, value=value)
        # This process may have ended it itself, before the answer of its database was lost
        if self.storage.get_trial(claim.trial_id).state is not TrialState.COMPLETE:
            raise TrialLostError(claim.run.key)

    def holds(self, claim: Claim) -> bool:
        """
        Return whether a run is still this process's own.

        :param claim: the run
        :return: whether no process has ended its trial
        """
        return not self.storage.get_trial(claim.trial_id).state.is_finished()

    def fruitless(self, claim: Claim) -> int:
        """
        Count the last attempts at a run that got no further than those before, this one included.

        :param claim: the run
        :return: the number
        """
        return fruitless(trial for trial in self.trials() if trial.user_attrs[KEY] == claim.run.key)

    def note_continuation(self, claim: Claim) -> None:
        """
        Note that a run goes on from a state, unless an earlier trial of this study has left it.

        :param claim: the run
        :raises TrialLostError: if another process has ended the trial
        """
        earlier = (trial for trial in self.trials() if trial.state.is_finished() and trial.user_attrs[KEY] == claim.run.key)
        if not any(PROGRESS in trial.user_attrs for trial in earlier):
            self.annotate(claim, CONTINUED, True)

    def fail(self, claim: Claim, error: BaseException) -> None:
        """
        End a run that failed for its own reasons.

        :param claim: the run
        :param error: the error
        """
        try:
            self.annotate(claim, ERROR, in_words(error))
        except TrialLostError:
            return
        self._end(claim.trial_id, TrialState.FAIL)

    def _end(self, trial_id: int, state: TrialState, outcome: str | None = None, value: float | None = None) -> None:
        try:
            if outcome is not None:
                self.storage.set_trial_user_attr(trial_id, OUTCOME, outcome)
            self.storage.set_trial_state_values(trial_id, state, None if value is None else [value])
        except UpdateFinishedTrialError:
            # Another process has ended it, or this one before the answer of its database was lost
            pass

    def _id(self, trial: FrozenTrial) -> int:
        return self.storage.get_trial_id_from_study_id_trial_number(self.study_id, trial.number)
