"""The callback that passes the evaluations and the steps of a run on to its study."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback

# Takes environment steps and the mean return of an evaluation
Report = Callable[[int, float], None]


class EvaluationReporter(BaseCallback):
    """Reports evaluations once each, by the method that subclasses define, and all of them again after a resumption."""

    def __init__(self) -> None:
        super().__init__()
        self._n_reported = 0

    def _report_new(self) -> None:
        """Report the evaluations since the last call."""
        raise NotImplementedError

    def _on_training_end(self) -> None:
        # A training that continues from its last step takes no other
        self._report_new()

    def get_training_state(self) -> dict[str, Any]:
        """
        Return an empty state: a training that continues reports all of its evaluations again.

        :return: an empty dictionary
        """
        return {}

    def set_training_state(self, state: dict[str, Any]) -> None:
        """
        Ignore the empty state.

        :param state: an empty dictionary
        """


class Reporter(EvaluationReporter):
    """
    Passes evaluations and steps on.

    :param evaluation: the callback that evaluates
    :param report: receives each evaluation
    :param watch: receives the environment steps at every step, and may raise
    """

    def __init__(self, evaluation: EvalCallback, report: Report, watch: Callable[[int], None]):
        super().__init__()
        self._evaluation = evaluation
        self._report = report
        self._watch = watch

    def _on_step(self) -> bool:
        self._watch(self.num_timesteps)
        self._report_new()
        return True

    def _report_new(self) -> None:
        timesteps, results = self._evaluation.evaluations_timesteps, self._evaluation.evaluations_results
        for step, returns in _new_points(timesteps, results, self._n_reported):
            self._report(step, float(np.mean(returns)))
        self._n_reported = len(timesteps)


def _new_points(
    timesteps: Sequence[int], results: Sequence[Sequence[float]], n_reported: int
) -> list[tuple[int, Sequence[float]]]:
    """Return the evaluations that were not reported, without those of offline policy training, which repeat the last step."""
    return [
        (timesteps[index], results[index])
        for index in range(n_reported, len(timesteps))
        if index == 0 or timesteps[index] > timesteps[index - 1]
    ]
