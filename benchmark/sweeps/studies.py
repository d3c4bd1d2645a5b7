"""
A sweep as an Optuna study that any number of processes, on any number of machines, work off together.

Each run is a trial that is enqueued, claimed by one process, and ended by it. What may go wrong at any moment is met by
three rules, which whoever looks at the study applies:

- A claimed trial has a heartbeat. If its count stands still for long, as the looker's own clock tells, the process is lost,
  and so is the trial: it ends as failed, without an error.
- A run without a trial that waits, runs, or has ended for good (completed, or failed with an error) gets a new one.
- Of several such trials, only the first is the run's. Whoever claims another gives it up.

A study is worked off when each run's own trial has ended for good; that no trial is open is not enough, as a process may
die, or be slow, between ending one and enqueueing the next.

So no run is skipped and none counts twice, whichever processes die between which two steps. Optuna's own heartbeat would
serve databases alone, not its proxy.
"""

import hashlib
import json
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from optuna.distributions import BaseDistribution, CategoricalDistribution, IntDistribution
from optuna.exceptions import DuplicatedStudyError, UpdateFinishedTrialError
from optuna.storages import BaseStorage
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial, TrialState, create_trial

from benchmark.common.records import Record
from benchmark.sweeps.experiments import Run, Sweep, overview
from benchmark.sweeps.heartbeats import PROGRESS, Silence, TrialLostError, send_beat
from benchmark.sweeps.storages import patiently
from benchmark.sweeps.sweep_files import SweepError

# Attributes of a study: what it is, and the beginning of those that each tell of a command that worked on it
SWEEP, COMMAND = "sweep", "command "
# Attributes of a trial
RUN, KEY, ERROR, WORKER, OUTCOME = "run", "key", "error", "worker", "outcome"


@dataclass(frozen=True)
class Claim:
    """
    A run that this process has taken.

    :param trial_id: the trial
    :param run: the run
    """

    trial_id: int
    run: Run


class Ledger:
    """
    A study's trials, by the rules above.

    :param storage: where the study is
    :param name: the study's name
    :param grace: seconds of silence after which a process is taken for lost
    :param clock: tells seconds
    """

    def __init__(self, storage: BaseStorage, name: str, grace: float = 60.0, clock: Callable[[], float] = time.monotonic):
        self.storage = storage
        self.name = name
        self._silence = Silence(grace, clock)
        self._study_id: int | None = None
        self._distributions: dict[str, BaseDistribution] = {}

    @property
    def study_id(self) -> int:
        """The study's number in its storage."""
        if self._study_id is None:
            self._study_id = patiently(self.storage.get_study_id_from_name, self.name)
        return self._study_id

    def open(self, sweep: Sweep, description: dict[str, Any], ended: Iterable[Record] = ()) -> None:
        """
        Make the study if it is not there, and enqueue what it lacks.

        :param sweep: the sweep
        :param description: what is to be known of the sweep, as JSON has it; its "commands", if any, join those of before
        :param ended: runs that ended elsewhere, and need not be trained
        :raises SweepError: if the study is there with other settings
        """
        try:
            self._study_id = patiently(self.storage.create_new_study, [StudyDirection.MAXIMIZE], self.name)
        except DuplicatedStudyError:
            self._study_id = None
        runs, trials = sweep.runs(), self.trials()
        self._distributions = _distributions(sweep)
        self._check(runs, trials)
        commands = description.get("commands", [])
        facts = {key: value for key, value in description.items() if key != "commands"}
        patiently(self.storage.set_study_user_attr, self.study_id, SWEEP, facts)
        self.adopt(ended, runs)
        self.enqueue_missing(runs)
        self._note(commands)

    def _check(self, runs: Sequence[Run], trials: Sequence[FrozenTrial]) -> None:
        # Optuna fixes what a study's parameters can be
        if trials and trials[0].distributions != self._distributions:
            raise SweepError(
                f"The study {self.name!r}", "", "has other methods, tasks or axes. Choose another name by --study"
            )
        present = {trial.user_attrs[KEY]: trial.user_attrs[RUN] for trial in trials}
        for run in runs:
            was, now = present.get(run.key), json.loads(json.dumps(asdict(run)))
            if was is not None and was != now:
                differing = next(name for name in now if was.get(name) != now[name])
                raise SweepError(
                    f"The study {self.name!r}",
                    differing,
                    f"was {was.get(differing)!r} and is now {now[differing]!r} for {run.key}. Choose another name by --study",
                )
        for name in ("steps", "evaluation_interval", "evaluation_episodes") if trials else ():
            before, after = trials[0].user_attrs[RUN][name], getattr(runs[0], name)
            if before != after:
                problem = f"was {before!r} and is now {after!r}. Choose another name by --study"
                raise SweepError(f"The study {self.name!r}", name, problem)

    def _note(self, commands: Iterable[dict[str, Any]]) -> None:
        """
        Note commands that train runs, each once, with the number of runs that had ended when it began.

        Each is an attribute of its own, as several machines may begin at once.
        """
        if not self.left():
            # What begins now has nothing to train; those of adopted runs have that number already
            commands = [command for command in commands if "runs_ended" in command]
        n_ended = sum(trial.state.is_finished() for trial in owned(self.trials()).values())
        present = patiently(self.storage.get_study_user_attrs, self.study_id)
        for command in commands:
            # Started again, it is the same, whatever else the machine has to do
            same = json.dumps({**command, "load_average": None, "runs_ended": None}, sort_keys=True)
            digest = hashlib.sha256(same.encode()).hexdigest()[:16]
            if not any(name.startswith(COMMAND) and name.endswith(digest) for name in present):
                name, value = f"{COMMAND}{time.time_ns()} {digest}", {"runs_ended": n_ended, **command}
                patiently(self.storage.set_study_user_attr, self.study_id, name, value)

    def trials(self) -> list[FrozenTrial]:
        """
        Read the study's trials, but for those that others may have added.

        :return: the trials, in their order
        """
        trials = patiently(self.storage.get_all_trials, self.study_id, deepcopy=False)
        return [trial for trial in trials if KEY in trial.user_attrs]

    def description(self) -> dict[str, Any]:
        """
        Read what is to be known of the sweep.

        :return: what :meth:`open` was given, with all runs that it was ever given, and all commands
        """
        attributes = patiently(self.storage.get_study_user_attrs, self.study_id)
        noted = [(value["runs_ended"], name) for name, value in attributes.items() if name.startswith(COMMAND)]
        commands = [attributes[name] for _, name in sorted(noted)]
        trials = self.trials()
        runs = [Run(**trial.user_attrs[RUN]) for trial in trials]
        given = overview(runs, _choices(trials, "method"), _choices(trials, "task"))
        return {**attributes[SWEEP], **given, "commands": commands}

    def enqueue_missing(self, runs: Iterable[Run], trials: Sequence[FrozenTrial] | None = None) -> None:
        """
        Give a trial to each run that has none.

        :param runs: the runs
        :param trials: the study's trials, if they were just read
        """
        trials = self.trials() if trials is None else trials
        keys = set(owned(trials))
        distributions = trials[0].distributions if trials else self._distributions
        for run in runs:
            if run.key not in keys:
                keys.add(run.key)
                trial = create_trial(
                    state=TrialState.WAITING,
                    params=_params(run),
                    distributions=distributions,
                    user_attrs={KEY: run.key, RUN: asdict(run)},
                )
                patiently(self.storage.create_new_trial, self.study_id, trial)

    def adopt(self, records: Iterable[Record], runs: Sequence[Run]) -> None:
        """
        Enter runs that ended elsewhere, as far as the study has not begun them.

        :param records: their records
        :param runs: the runs of the sweep
        """
        by_key = {run.key: run for run in runs}
        owners = owned(self.trials())
        for record in records:
            key, owner = record.key, owners.get(record.key)
            if key not in by_key or (owner is not None and owner.state is not TrialState.WAITING):
                continue
            attributes = {KEY: key, RUN: asdict(by_key[key]), PROGRESS: {"step": record.steps, "seconds": record.seconds}}
            trial = create_trial(
                state=TrialState.FAIL if record.final is None else TrialState.COMPLETE,
                value=record.final,
                params=_params(by_key[key]),
                distributions=self._distributions,
                user_attrs=attributes | {OUTCOME: "adopted"} | ({} if record.error is None else {ERROR: record.error}),
                intermediate_values=dict(zip(record.timesteps, record.returns, strict=True)),
            )
            patiently(self.storage.create_new_trial, self.study_id, trial)
            # As long as it waits, or if a process takes it first, it is the run's
            if owner is not None and self._take(owner_id := self._id(owner)):
                self._end(owner_id, TrialState.FAIL, outcome="given up: the run was adopted")

    def recover(self) -> None:
        """End the trials of processes that have fallen silent, and enqueue what is missing then."""
        trials = self.trials()
        silent = self._silence.find(trials)
        for trial in silent:
            self._end(self._id(trial), TrialState.FAIL, outcome="lost: its process fell silent")
        trials = self.trials() if silent else trials
        self.enqueue_missing((Run(**trial.user_attrs[RUN]) for trial in trials), trials)

    def claim(self, worker: str) -> Claim | None:
        """
        Take a run that nobody has.

        :param worker: this process's name, for people
        :return: the run; None if no run waits
        """
        for trial in self.trials():
            if trial.state is not TrialState.WAITING:
                continue
            trial_id = self._id(trial)
            if not self._take(trial_id):
                continue
            # None: this process was away for so long that it was given up meanwhile
            owner = owned(self.trials()).get(trial.user_attrs[KEY])
            if owner is None or owner.number != trial.number:
                self._end(trial_id, TrialState.FAIL, outcome="given up: the run has another trial")
                continue
            try:
                patiently(self.storage.set_trial_user_attr, trial_id, WORKER, worker)
            except UpdateFinishedTrialError:
                continue
            return Claim(trial_id, Run(**trial.user_attrs[RUN]))
        return None

    def _take(self, trial_id: int) -> bool:
        try:
            return patiently(self.storage.set_trial_state_values, trial_id, TrialState.RUNNING)
        except UpdateFinishedTrialError:
            return False

    def left(self) -> list[str]:
        """
        List the runs that are not over.

        :return: their keys
        """
        trials = self.trials()
        ended = {key for key, trial in owned(trials).items() if trial.state.is_finished()}
        # Also trials that are not the run's own are ended before all is over
        left = (trial for trial in trials if trial.user_attrs[KEY] not in ended or not trial.state.is_finished())
        return list(dict.fromkeys(trial.user_attrs[KEY] for trial in left))

    def beat(self, claim: Claim, count: str, step: int, seconds: float) -> None:
        """
        Say that this process is alive, and how far the run is.

        :param claim: the run
        :param count: what has not been said yet
        :param step: environment steps so far
        :param seconds: what this attempt has taken so far
        :raises TrialLostError: if the trial is not this process's any more
        """
        send_beat(self.storage, claim.trial_id, count, step, seconds)

    def report(self, claim: Claim, step: int, value: float) -> None:
        """
        Record an evaluation.

        :param claim: the run
        :param step: environment steps
        :param value: mean return
        :raises TrialLostError: if the trial is not this process's any more
        """
        try:
            patiently(self.storage.set_trial_intermediate_value, claim.trial_id, step, value)
        except UpdateFinishedTrialError as error:
            raise TrialLostError(claim.run.key) from error

    def complete(self, claim: Claim, value: float) -> None:
        """
        End a run.

        :param claim: the run
        :param value: mean return of the final model
        :raises TrialLostError: if the trial is not this process's any more
        """
        self._end(claim.trial_id, TrialState.COMPLETE, value=value)
        # It may be this process that has ended it, before its database's answer was lost
        if patiently(self.storage.get_trial, claim.trial_id).state is not TrialState.COMPLETE:
            raise TrialLostError(claim.run.key)

    def fail(self, claim: Claim, error: BaseException) -> None:
        """
        End a run that failed for its own reasons.

        :param claim: the run
        :param error: the error
        """
        text = f"{type(error).__name__}: {error}"
        try:
            patiently(self.storage.set_trial_user_attr, claim.trial_id, ERROR, text)
        except UpdateFinishedTrialError:
            return
        self._end(claim.trial_id, TrialState.FAIL)

    def release(self, claim: Claim) -> None:
        """
        Give a run back that is not finished, to be taken up again.

        :param claim: the run
        """
        self._end(claim.trial_id, TrialState.FAIL, outcome="given back: its process was stopped")
        self.enqueue_missing([claim.run])

    def _end(self, trial_id: int, state: TrialState, outcome: str | None = None, value: float | None = None) -> None:
        try:
            if outcome is not None:
                patiently(self.storage.set_trial_user_attr, trial_id, OUTCOME, outcome)
            patiently(self.storage.set_trial_state_values, trial_id, state, None if value is None else [value])
        except UpdateFinishedTrialError:
            # Ended by another, or by this process before its database answered
            pass

    def _id(self, trial: FrozenTrial) -> int:
        return patiently(self.storage.get_trial_id_from_study_id_trial_number, self.study_id, trial.number)

    def records(self) -> list[Record]:
        """
        List the runs that have ended for good.

        :return: their records
        """
        trials = self.trials()
        experiment = self.description()["experiment"]
        spent: dict[str, float] = defaultdict(float)
        for trial in trials:
            spent[trial.user_attrs[KEY]] += _seconds(trial)
        return [_record(experiment, trial, spent[key]) for key, trial in owned(trials).items() if trial.state.is_finished()]


def is_open_or_ended(trial: FrozenTrial) -> bool:
    """
    Tell whether a run with such a trial needs no other.

    :param trial: the trial
    :return: whether it waits, runs, is completed, or has failed with an error
    """
    return trial.state is not TrialState.FAIL or ERROR in trial.user_attrs


def owned(trials: Iterable[FrozenTrial]) -> dict[str, FrozenTrial]:
    """
    Find the trial of each run.

    :param trials: the study's trials
    :return: by the run's key, its first trial that needs no other
    """
    owners: dict[str, FrozenTrial] = {}
    for trial in sorted(trials, key=lambda trial: trial.number):
        if is_open_or_ended(trial):
            owners.setdefault(trial.user_attrs[KEY], trial)
    return owners


def _seconds(trial: FrozenTrial) -> float:
    return trial.user_attrs.get(PROGRESS, {}).get("seconds", 0.0)


def _params(run: Run) -> dict[str, Any]:
    return {"method": run.method, "task": run.task, **run.settings, "seed": run.seed}


def _choices(trials: Sequence[FrozenTrial], name: str) -> list[Any]:
    distribution = trials[0].distributions[name] if trials else None
    return list(distribution.choices) if isinstance(distribution, CategoricalDistribution) else []


def _distributions(sweep: Sweep) -> dict[str, BaseDistribution]:
    choices: dict[str, list[Any]] = {"method": list(sweep.file.methods), "task": sweep.file.tasks}
    choices |= {name: list(axis.values) for name, axis in sweep.file.axes.items()}
    # A study may get more seeds later
    return {
        **{name: CategoricalDistribution(values) for name, values in choices.items()},
        "seed": IntDistribution(0, 2**32 - 1),
    }


def _record(experiment: str, trial: FrozenTrial, seconds: float) -> Record:
    run, points = trial.user_attrs[RUN], sorted(trial.intermediate_values.items())
    return Record(
        experiment,
        run["method"],
        run["task"],
        run["settings"],
        run["seed"],
        run["steps"],
        [step for step, _ in points],
        [value for _, value in points],
        trial.value if trial.state is TrialState.COMPLETE else None,
        trial.user_attrs.get(ERROR),
        seconds,
    )
