"""
The execution of a tuning: each trial is a configuration that is trained with one seed after another.

A trial whose process is lost or stopped is enqueued again with the scores of the seeds that were finished; the run of its
unfinished seed continues from its last state.
"""

import time
import traceback
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path

import optuna
from optuna.exceptions import UpdateFinishedTrialError
from optuna.samplers import TPESampler
from optuna.storages import BaseStorage
from optuna.trial import FrozenTrial, TrialState

from benchmark.sweeps.attempts import MAX_FRUITLESS_ATTEMPTS, SUSPECT, fruitless, in_words, outcome_of
from benchmark.sweeps.heartbeats import HeartbeatThread, SilenceDetector, TrialLostError, send_beat
from benchmark.sweeps.locks import locked
from benchmark.sweeps.run import MACHINE_ERRORS, forget_states, run_folder, train
from benchmark.sweeps.scoring import PRUNERS, SCORING
from benchmark.sweeps.signals import end_if_asked, undisturbed
from benchmark.sweeps.study_trials import ERROR, LOST, OUTCOME, STOPPED, SWEEP, TUNING
from benchmark.sweeps.tuning import ORIGIN, SCORES, Tuning
from benchmark.sweeps.validation import SweepError


class Tuner:
    """
    The study of a tuning, whose configurations this process samples and trains.

    :param storage: the storage of the study
    :param name: the study's name
    :param tuning: the tuning
    :param grace: seconds of silence after which a process is taken for lost
    """

    def __init__(self, storage: BaseStorage, name: str, tuning: Tuning, grace: float):
        self._storage, self._tuning = storage, tuning
        self._silence = SilenceDetector(grace)
        self._study = optuna.create_study(
            storage=storage,
            study_name=name,
            direction="maximize",
            load_if_exists=True,
            # Without a seed: with one, each process would suggest the same as the others
            sampler=TPESampler(multivariate=True, constant_liar=True),
            pruner=PRUNERS[tuning.pruner](),
        )
        self._study_id = storage.get_study_id_from_name(name)
        self._check()

    def _check(self) -> None:
        now = asdict(self._tuning)
        attributes = self._study.user_attrs
        was = attributes.get(TUNING)
        if was is None:
            if SWEEP in attributes or self.trials():
                problem = "holds the trials of a sweep, or of another program. Choose another name by --study"
                raise SweepError(f"The study {self._study.study_name!r}", "", problem)
            self._study.set_user_attr(TUNING, now)
        elif was != now:
            # Another version may have had other settings
            key = next(key for key in {**was, **now} if was.get(key) != now.get(key))
            problem = f"was {was.get(key)!r} and is now {now.get(key)!r}. Choose another name by --study"
            raise SweepError(f"The study {self._study.study_name!r}", key, problem)

    def trials(self) -> list[FrozenTrial]:
        """
        Read the study's trials.

        :return: the trials
        """
        return self._study.get_trials(deepcopy=False)

    def recover(self) -> None:
        """
        Enqueue the configurations of lost processes again, but for one whose processes are lost every time at the same step.

        If this process dies between the two steps of that, a configuration is lost, and another is sampled in its place.
        """
        for trial in self._silence.find(self.trials()):
            with undisturbed():
                self._give_back(trial.number, LOST)

    def _give_back(self, number: int, outcome: str) -> None:
        trial_id = self._id(number)
        try:
            if outcome != STOPPED and fruitless(self._attempts(number)) >= MAX_FRUITLESS_ATTEMPTS:
                self._storage.set_trial_user_attr(trial_id, ERROR, outcome.removeprefix(SUSPECT))
            self._storage.set_trial_user_attr(trial_id, OUTCOME, outcome)
            self._storage.set_trial_state_values(trial_id, TrialState.FAIL)
        except UpdateFinishedTrialError:
            return
        trial = self._storage.get_trial(trial_id)
        # Some parameters of an enqueued configuration may not have been suggested again yet
        params = {**trial.system_attrs.get("fixed_params", {}), **trial.params}
        if params and ERROR not in trial.user_attrs:
            attributes = {ORIGIN: trial.user_attrs.get(ORIGIN, trial.number), SCORES: trial.user_attrs.get(SCORES, [])}
            self._study.enqueue_trial(params, attributes)

    def _attempts(self, number: int) -> list[FrozenTrial]:
        """List the trials of a trial's configuration."""
        trials = self.trials()
        origin = trials[number].user_attrs.get(ORIGIN, number)
        return [trial for trial in trials if trial.user_attrs.get(ORIGIN, trial.number) == origin]

    def _id(self, number: int) -> int:
        return self._storage.get_trial_id_from_study_id_trial_number(self._study_id, number)

    def attempt(self, logs: Path, interval: float, parent: int | None, device: str) -> None:
        """
        Take a trial that waits, or a new one, train its configuration with each seed, and end it.

        :param logs: the folder of all studies' runs
        :param interval: seconds between two heartbeats
        :param parent: the process that started this one
        :param device: device of the networks
        """
        trial: optuna.Trial | None = None
        try:
            with undisturbed():
                trial = self._study.ask()
            end_if_asked()
            self._train(trial, logs, interval, parent, device)
        except (SystemExit, KeyboardInterrupt):
            if trial is not None:
                with undisturbed():
                    self._give_back(trial.number, STOPPED)
            raise

    def _train(self, trial: optuna.Trial, logs: Path, interval: float, parent: int | None, device: str) -> None:
        trial_id = self._id(trial.number)

        def beat(count: str, step: int, *seconds: float) -> None:
            send_beat(self._storage, trial_id, count, step, *seconds)

        try:
            with HeartbeatThread(beat, interval, parent) as heartbeat:
                self._tuning.sample(trial)
                scores = self._scores(trial, trial_id, logs, heartbeat, device)
            value = None if scores is None else SCORING[self._tuning.score](scores)
            state = TrialState.PRUNED if value is None else TrialState.COMPLETE
            with suppress(UpdateFinishedTrialError):
                # Another process has ended it, or this one before the answer of its database was lost
                self._study.tell(trial, value, state, skip_if_finished=True)
        except (TrialLostError, UpdateFinishedTrialError):
            print(f"Trial {trial.number} was given to another process", flush=True)
        except MACHINE_ERRORS as error:
            with undisturbed():
                self._give_back(trial.number, outcome_of(error))
            raise
        except Exception as error:
            traceback.print_exc()
            with undisturbed():
                self._fail(trial_id, error)

    def _scores(
        self, trial: optuna.Trial, trial_id: int, logs: Path, heartbeat: HeartbeatThread, device: str
    ) -> list[float] | None:
        """Train a configuration with one seed after another; None if it is pruned."""
        frozen = self._storage.get_trial(trial_id)
        scores = list(frozen.user_attrs.get(SCORES, []))
        for seed in range(self._tuning.seeds):
            if seed == len(scores):
                run = self._tuning.run(frozen, seed)
                folder = run_folder(logs, self._study.study_name, run)
                print(f"{time.strftime('%H:%M:%S')} {run.key}", flush=True)
                with locked([folder]):
                    scores.append(train(run, folder, lambda step, value: None, heartbeat.watch, device))
                trial.set_user_attr(SCORES, scores)
                forget_states(folder)
            # Wilcoxon's test pairs the seeds; the other pruners compare the scores so far
            is_paired = self._tuning.pruner == "wilcoxon"
            value = scores[seed] if is_paired else SCORING[self._tuning.score](scores[: seed + 1])
            trial.report(value, seed)
            if seed + 1 < self._tuning.seeds and trial.should_prune():
                return None
        return scores

    def _fail(self, trial_id: int, error: Exception) -> None:
        try:
            self._storage.set_trial_user_attr(trial_id, ERROR, in_words(error))
            self._storage.set_trial_state_values(trial_id, TrialState.FAIL)
        except UpdateFinishedTrialError:
            pass


def has_ended(trial: FrozenTrial) -> bool:
    """
    Return whether a trial's configuration has ended.

    :param trial: the trial
    :return: whether it was scored, was pruned, or failed for its own reasons
    """
    return trial.state in (TrialState.COMPLETE, TrialState.PRUNED) or ERROR in trial.user_attrs


def best_of(trials: Iterable[FrozenTrial]) -> FrozenTrial | None:
    """
    Return the best configuration.

    :param trials: a study's trials
    :return: the trial with the highest score; None if no configuration has one
    """
    completed = [trial for trial in trials if trial.state is TrialState.COMPLETE]
    return max(completed, key=lambda trial: trial.values[0], default=None)
