"""The callback that passes the evaluations, the steps and the failures of a population's agents on to their study."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from benchmark.sweeps.claimed_runs import ClaimedRuns
from benchmark.sweeps.reporter import EvaluationReporter
from benchmark.sweeps.runs import Run
from sb3_cgp.population import Population, PopulationEvalCallback


class PopulationReporter(EvaluationReporter):
    """
    Passes evaluations, steps and failures on, and ends the training when no run is open any more.

    It also writes each run's ``evaluations.npz``, as SB3's ``EvalCallback`` does.

    :param runs: the run of each agent
    :param folders: the folder of each run
    :param evaluation: the callback that evaluates
    :param claimed: receives evaluations and failures
    :param watch: receives the environment steps of each run at every step, and may raise
    """

    model: Population

    def __init__(
        self,
        runs: Sequence[Run],
        folders: Sequence[Path],
        evaluation: PopulationEvalCallback,
        claimed: ClaimedRuns,
        watch: Callable[[int], None],
    ):
        super().__init__()
        self._runs, self._folders = runs, folders
        self._evaluation, self._claimed, self._watch = evaluation, claimed, watch

    def _on_step(self) -> bool:
        self._watch(self.num_timesteps // len(self._runs))
        self._report_new()
        self.report_failures()
        return self._claimed.has_open

    def report_failures(self) -> None:
        """End the runs of the agents that have failed, and the logs of their episodes."""
        for index, reason in self.model.failed.items():
            if self._claimed.is_open(self._runs[index]):
                self._claimed.fail(self._runs[index], ValueError(reason))
                assert self.model.env is not None
                self.model.env.env_method("set_wrapper_attr", "results_writer", None, indices=index)

    def _report_new(self) -> None:
        evaluation = self._evaluation
        timesteps = evaluation.evaluations_timesteps
        if len(timesteps) == self._n_reported:
            return
        results, lengths = np.array(evaluation.evaluations_results), np.array(evaluation.evaluations_length)
        for index, (run, folder) in enumerate(zip(self._runs, self._folders, strict=True)):
            if self._claimed.is_open(run):
                for number in range(self._n_reported, len(timesteps)):
                    self._claimed.report(run, timesteps[number], float(results[number, index].mean()))
                own = {"timesteps": timesteps, "results": results[:, index], "ep_lengths": lengths[:, index]}
                np.savez(folder / "evaluations", **own)  # type: ignore[arg-type]
        self._n_reported = len(timesteps)
