"""Scores of configurations over their seeds, and the pruning of configurations that score less than others."""

from collections.abc import Callable, Sequence

import numpy as np
import optuna
from optuna.pruners import BasePruner, NopPruner, WilcoxonPruner
from optuna.trial import FrozenTrial, TrialState
from scipy.stats import trim_mean

# Number of complete trials before the first trial is pruned
N_STARTUP_TRIALS = 5
SCORING: dict[str, Callable[[Sequence[float]], float]] = {
    "mean": lambda scores: float(np.mean(scores)),
    # Without the lowest and the highest quarter
    "iqm": lambda scores: float(trim_mean(scores, 0.25)),
    "min": min,
}


class ScorePruner(BasePruner):
    """
    Gives a configuration up that scores less than the median of complete trials after as many seeds.

    Optuna's median pruner compares a trial's best score so far.
    """

    def prune(self, study: optuna.Study, trial: FrozenTrial) -> bool:
        """
        Compare a trial's last score with those of complete trials.

        :param study: the study
        :param trial: the trial
        :return: whether the trial is given up
        """
        step = trial.last_step
        complete = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
        others = [each.intermediate_values[step] for each in complete if step in each.intermediate_values]
        if step is None or len(others) < N_STARTUP_TRIALS:
            return False
        return trial.intermediate_values[step] < float(np.median(others))


PRUNERS: dict[str, Callable[[], BasePruner]] = {
    "median": ScorePruner,
    "wilcoxon": lambda: WilcoxonPruner(p_threshold=0.1),
    "none": NopPruner,
}
