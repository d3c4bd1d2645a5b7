"""
A sweep as an Optuna study, whose runs any number of processes on any number of machines execute together.

Each run is a trial that is enqueued, claimed by one process, and ended by it. Three rules, which every process applies when it
reads the study, cover all interruptions:

- A claimed trial has a heartbeat. If its count stands still for longer than the grace period, by the reading process's own
  clock, the process is lost, and so is the trial: it ends as failed, without an error.
- A run without a trial that waits, runs, or has ended for good (completed, or failed with an error) gets a new one.
- Of several such trials, only the first is the run's own. A process that claims another one ends it.

A study is finished when each run's own trial has ended for good. That no trial is open is not enough, as a process may die
between ending one trial and enqueueing the next.

So no run is skipped and none counts twice, whichever processes die between any two steps. Optuna's own heartbeat works with
databases only, not with its proxy.
"""

import hashlib
import json
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

from optuna.distributions import BaseDistribution
from optuna.exceptions import DuplicatedStudyError
from optuna.storages import BaseStorage
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial, TrialState, create_trial

from benchmark.common.records import Record
from benchmark.sweeps.experiments import Sweep, difference
from benchmark.sweeps.heartbeats import PROGRESS, SilenceDetector, TrialLostError
from benchmark.sweeps.runs import Run
from benchmark.sweeps.study_trials import (
    COMMAND,
    ERROR,
    KEY,
    LOST,
    OUTCOME,
    POPULATION,
    PROCESSORS,
    SHARED,
    STOPPED,
    SWEEP,
    TUNING,
    WORKER,
    Claim,
    attributes_of,
    distributions_of,
    owned,
    params_of,
    run_of,
)
from benchmark.sweeps.trial_writer import TrialWriter
from benchmark.sweeps.validation import SweepError


class Ledger(TrialWriter):
    """
    A study whose trials this process enqueues, claims and ends by the rules above.

    :param storage: the storage of the study
    :param name: the study's name
    :param grace: seconds of silence after which a process is taken for lost
    :param clock: returns seconds
    """

    def __init__(self, storage: BaseStorage, name: str, grace: float = 60.0, clock: Callable[[], float] = time.monotonic):
        super().__init__(storage, name)
        self._silence = SilenceDetector(grace, clock)
        self._distributions: dict[str, BaseDistribution] = {}

    def open(self, sweep: Sweep, description: dict[str, Any], ended: Iterable[Record] = ()) -> None:
        """
        Create the study if the storage does not hold it, and enqueue the runs that it lacks.

        :param sweep: the sweep
        :param description: the sweep's description, as JSON has it; its "commands", if any, join those of before
        :param ended: runs that ended elsewhere, which are not trained again
        :raises SweepError: if the study exists with other settings, or with the trials of a tuning
        """
        try:
            self._study_id = self.storage.create_new_study([StudyDirection.MAXIMIZE], self.name)
        except DuplicatedStudyError:
            self._study_id = None
        runs, trials = sweep.runs(), self.trials()
        attributes = self.storage.get_study_user_attrs(self.study_id)
        if TUNING in attributes:
            raise self._refusal("", "holds the trials of a tuning")
        self._distributions = distributions_of(sweep)
        self._check(runs, trials)
        # Other methods than those of the runs
        if found := difference(attributes.get(SWEEP, {}).get(SHARED), sweep.shared):
            raise self._refusal(*found)
        commands = description.get("commands", [])
        facts = {key: value for key, value in description.items() if key != "commands"}
        self.storage.set_study_user_attr(self.study_id, SWEEP, facts)
        self.adopt(ended, runs)
        self.enqueue_missing(runs)
        self._record_commands(commands)

    def _check(self, runs: Sequence[Run], trials: Sequence[FrozenTrial]) -> None:
        # Optuna fixes the values that a study's parameters can have
        if trials and trials[0].distributions != self._distributions:
            raise self._refusal("", "has other methods, tasks or axes")
        present = [run_of(trial) for trial in trials]
        by_key = {run.key: run for run in present}
        # Further seeds of a configuration must have its hyperparameters, too
        of_cells = {(run.task, run.configuration): run for run in present}
        for run in runs:
            earlier = by_key.get(run.key, of_cells.get((run.task, run.configuration)))
            if earlier is None:
                continue
            was, now = asdict(earlier), json.loads(json.dumps(asdict(run)))
            # Hyperparameters last, as the number of random steps may follow from the number of steps
            for name in sorted(now.keys() - {"seed"}, key=lambda name: (name == "hyperparams", name)):
                if was[name] != now[name]:
                    raise self._refusal(name, f"was {was[name]!r} and is now {now[name]!r} for {run.key}")
        for name in ("steps", "evaluation_interval", "evaluation_episodes") if trials else ():
            before, after = getattr(present[0], name), getattr(runs[0], name)
            if before != after:
                raise self._refusal(name, f"was {before!r} and is now {after!r}")

    def _refusal(self, key: str, problem: str) -> SweepError:
        return SweepError(f"The study {self.name!r}", key, f"{problem}. Choose another name by --study")

    def _record_commands(self, commands: Iterable[dict[str, Any]]) -> None:
        """
        Record commands that train runs, each once, with the number of runs that had ended when it began.

        Each is an attribute of its own, as several machines may begin at once.
        """
        if not self.left():
            # A command that begins now has nothing to train; those of adopted runs have that number already
            commands = [command for command in commands if "runs_ended" in command]
        n_ended = sum(trial.state.is_finished() for trial in owned(self.trials()).values())
        present = self.storage.get_study_user_attrs(self.study_id)
        for command in commands:
            # A command that is started again is the same, whatever the machine's load
            same = json.dumps({**command, "load_average": None, "runs_ended": None}, sort_keys=True)
            digest = hashlib.sha256(same.encode()).hexdigest()[:16]
            if not any(name.startswith(COMMAND) and name.endswith(digest) for name in present):
                name, value = f"{COMMAND}{time.time_ns()} {digest}", {"runs_ended": n_ended, **command}
                self.storage.set_study_user_attr(self.study_id, name, value)

    def enqueue_missing(self, runs: Iterable[Run], trials: Sequence[FrozenTrial] | None = None) -> None:
        """
        Enqueue a trial for each run that has none.

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
                    params=params_of(run),
                    distributions=distributions,
                    user_attrs=attributes_of(run),
                )
                self.storage.create_new_trial(self.study_id, trial)

    def adopt(self, records: Iterable[Record], runs: Sequence[Run]) -> None:
        """
        Add runs that ended elsewhere, unless this study has begun them.

        :param records: their records
        :param runs: the runs of the sweep
        """
        by_key = {run.key: run for run in runs}
        owners = owned(self.trials())
        for record in records:
            run, owner = by_key.get(record.key), owners.get(record.key)
            if run is None or (owner is not None and owner.state is not TrialState.WAITING):
                continue
            spent = {"seconds": record.seconds, "processor_seconds": record.processor_seconds}
            progress = {PROGRESS: {"step": record.steps, **spent}, OUTCOME: "adopted"}
            population = {} if record.population == 1 else {POPULATION: {"agents": record.population}}
            error = {} if record.error is None else {ERROR: record.error}
            processors = {PROCESSORS: record.processors} if record.processors else {}
            trial = create_trial(
                state=TrialState.FAIL if record.final is None else TrialState.COMPLETE,
                value=record.final,
                params=params_of(run),
                distributions=self._distributions,
                user_attrs=attributes_of(run) | progress | population | error | processors,
                intermediate_values=dict(zip(record.timesteps, record.returns, strict=True)),
            )
            self.storage.create_new_trial(self.study_id, trial)
            # A trial that waits remains the run's own until it ends, and so does one that a process takes first
            if owner is not None and self._take(owner_id := self._id(owner)):
                self._end(owner_id, TrialState.FAIL, outcome="given up: the run was adopted")

    def recover(self) -> None:
        """End the trials of processes that have fallen silent, and enqueue the runs that lack a trial then."""
        trials = self.trials()
        silent = self._silence.find(trials)
        for trial in silent:
            self._end(self._id(trial), TrialState.FAIL, outcome=LOST)
        trials = self.trials() if silent else trials
        self.enqueue_missing(map(run_of, trials), trials)

    def claim(
        self, worker: str, trials: Iterable[FrozenTrial] | None = None, attributes: Mapping[str, Any] | None = None
    ) -> Claim | None:
        """
        Take a run that waits.

        :param worker: this process's name, for people
        :param trials: the trials to try, in their order; None for all of the study
        :param attributes: further attributes of the trial, which are set before the worker's name
        :return: the run; None if none of the trials waits any more
        """
        for trial in self.trials() if trials is None else trials:
            if trial.state is not TrialState.WAITING:
                continue
            trial_id = self._id(trial)
            if not self._take(trial_id):
                continue
            # None if another process has given this one up in the meantime
            owner = owned(self.trials()).get(trial.user_attrs[KEY])
            if owner is None or owner.number != trial.number:
                self._end(trial_id, TrialState.FAIL, outcome="given up: the run has another trial")
                continue
            claim = Claim(trial_id, run_of(trial))
            try:
                for name, value in {**(attributes or {}), WORKER: worker}.items():
                    self.annotate(claim, name, value)
            except TrialLostError:
                continue
            return claim
        return None

    def release(self, claim: Claim, outcome: str = STOPPED) -> None:
        """
        Give back a run that is not finished, to be continued by any process.

        :param claim: the run
        :param outcome: the reason, for people
        """
        self._end(claim.trial_id, TrialState.FAIL, outcome=outcome)
        self.enqueue_missing([claim.run])
