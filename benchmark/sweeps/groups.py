"""
Groups of runs that one process trains as a population, and which runs a process takes next.

A process takes the first run that waits and, with it, runs that have the same common settings, up to the size of a
population. First are the runs with a saved state on this machine, then those that have not begun by their place in the sweep,
so that processes that end before a run does finish one run after another, then those that another machine may continue. Last
are those whose last attempt ended in an error, or whose last attempts came to nothing: they may end this process, too. Three
kinds of runs are exceptions:

- A run whose population has a saved state on this machine goes on as an agent of that population, whatever the size is now.
  All of the population's runs that wait are taken together. None of them is taken while another one is still being trained,
  as it is while some trials of a killed process are not yet known to be lost.
- A run that has a saved state of its own goes on alone.
- A run whose population was dissolved, because of an error that was no single agent's, is trained alone.

Runs of a population that have ended, or that another process has taken, stay in it as agents whose results are not recorded.
"""

import argparse
import hashlib
import json
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from optuna.trial import FrozenTrial, TrialState
from stable_baselines3.common.utils import get_device

from benchmark.common.arguments import count
from benchmark.sweeps.attempts import DISSOLVED, ended_by_error, fruitless
from benchmark.sweeps.heartbeats import PROGRESS, TrialLostError
from benchmark.sweeps.run import has_state, run_folder
from benchmark.sweeps.runs import Run
from benchmark.sweeps.sharing import common_settings
from benchmark.sweeps.studies import Ledger
from benchmark.sweeps.study_trials import KEY, OUTCOME, POPULATION, WORKER, Claim, owned, run_of
from sb3_cgp.common.files import write_atomically
from sb3_cgp.resumption.store import StateStore
from sb3_cgp.zoo.folders import state_folder

# The folder of all populations, beside those of a study's configurations
FOLDER = "populations"
# The file in a population's folder with its runs
GROUP_RUNS = "runs.json"
# Agents of a population on a GPU by default
ON_GPU = 32


def add_population(parser: argparse.ArgumentParser) -> None:
    """
    Add the argument on the size of populations.

    :param parser: the command's parser
    """
    parser.add_argument(
        "--population",
        default="auto",
        type=_size,
        metavar="N",
        help="most runs that a process trains together, as agents of one population (default: "
        f"{ON_GPU} on a GPU and 1, each run alone, on a CPU, where a population gains nothing)",
    )


def _size(text: str) -> int | str:
    return text if text == "auto" else count(text)


def population_size(size: int | str, device: str) -> int:
    """
    Return the most runs that a process trains together.

    :param size: a number, or "auto"
    :param device: device of the networks
    :return: the number
    """
    if isinstance(size, int):
        return size
    return ON_GPU if get_device(device).type == "cuda" else 1


@dataclass(frozen=True)
class Group:
    """
    Runs that are trained as one population.

    :param folder: the population's folder
    :param runs: the runs; run i is agent i's
    """

    folder: Path
    runs: list[Run]

    @classmethod
    def of(cls, folder: Path, runs: Sequence[Run]) -> "Group":
        """
        Make the group of runs.

        :param folder: the folder of the study's runs
        :param runs: the runs
        :return: the group, whose folder is that of all groups of the same runs in the same order
        """
        return cls(folder / FOLDER / hashlib.sha256(_as_json(runs)).hexdigest()[:16], list(runs))

    @classmethod
    def read(cls, folder: Path) -> "Group":
        """
        Read the group of a folder.

        :param folder: the population's folder
        :return: the group
        :raises SweepError: if another version of sb3-cgp described its runs, by other fields
        """
        path = folder / GROUP_RUNS
        return cls(folder, [Run.from_fields(described, path) for described in json.loads(path.read_bytes())])

    def write(self) -> None:
        """Write the runs to the group's folder, for the process that goes on with it."""
        self.folder.mkdir(parents=True, exist_ok=True)
        write_atomically(self.folder / GROUP_RUNS, _as_json(self.runs))

    @property
    def states(self) -> Path:
        """The folder of the population's training states."""
        return Path(state_folder(str(self.folder)))

    @property
    def mark(self) -> dict[str, Any]:
        """The attribute of the runs' trials."""
        return {"name": self.folder.name, "agents": len(self.runs)}


@dataclass(frozen=True)
class Plan:
    """
    Trials to take together.

    :param trials: the trials, of which the first one has to be taken before the others
    :param group: the group that goes on; None for a new one, or a single run
    """

    trials: list[FrozenTrial]
    group: Group | None = None


class Groups:
    """
    The groups of a study's runs on this machine.

    :param logs: the folder of all sweeps' runs
    :param study: the study's name
    :param size: the largest number of runs of a new group
    """

    def __init__(self, logs: Path, study: str, size: int):
        self._logs, self._study, self._size = logs, study, size
        self._folder = logs / study

    def claim(self, ledger: Ledger, worker: str) -> tuple[list[Claim], Group | None]:
        """
        Take the runs that this process trains next.

        :param ledger: the study
        :param worker: this process's name, for people
        :return: the runs, none if no run can be taken now, and their group; None for a run that is trained alone
        """
        for plan in self.plans(ledger.trials()):
            attributes = {} if plan.group is None else {POPULATION: plan.group.mark}
            first = ledger.claim(worker, plan.trials[:1], attributes)
            # A process that does not get the first trial leaves the others to the one that has it
            rest = [] if first is None else [ledger.claim(worker, [trial], attributes) for trial in plan.trials[1:]]
            claims, group = [claim for claim in (first, *rest) if claim is not None], plan.group
            if group is None and len(claims) > 1:
                group = Group.of(self._folder, [claim.run for claim in claims])
                claims = [claim for claim in claims if _annotate(ledger, claim, group)]
            if claims:
                return claims, group
        return [], None

    def plans(self, trials: Sequence[FrozenTrial]) -> Iterator[Plan]:
        """
        List what a process may take next, by the rules above.

        :param trials: the study's trials
        :return: the plans, in the order in which a process tries them
        """
        owners, names = owned(trials), _names(trials)
        # By run, all of its trials
        attempts: dict[str, list[FrozenTrial]] = defaultdict(list)
        for trial in trials:
            attempts[trial.user_attrs[KEY]].append(trial)
        waiting = [trial for trial in trials if trial.state is TrialState.WAITING]
        # A trial that is not its run's own is taken alone, and ended
        own = [trial for trial in waiting if owners[trial.user_attrs[KEY]].number == trial.number]
        begun = {trial.number: group for trial in own if (group := self._begun(trial, names)) is not None}
        alone = {trial.number for trial in own if trial.number not in begun and self._has_state(trial)}

        def place(trial: FrozenTrial) -> tuple[int, bool, bool, bool, bool, int]:
            of_run = attempts[trial.user_attrs[KEY]]
            has_state = trial.number in begun or trial.number in alone
            # Another machine may continue it
            is_elsewhere = not has_state and any(PROGRESS in each.user_attrs for each in of_run)
            is_risky = ended_by_error(of_run)
            return fruitless(of_run), is_risky, trial.number not in begun, not has_state, is_elsewhere, of_run[0].number

        waiting.sort(key=place)
        # By trial, what it has in common with others; only of those that may begin in a population
        common: dict[int, str] = {}
        for trial in own if self._size > 1 else ():
            if trial.number not in begun and trial.number not in alone and not _is_dissolved(attempts[trial.user_attrs[KEY]]):
                settings = common_settings(run_of(trial))
                common |= {} if settings is None else {trial.number: settings}
        seen = set()
        for index, trial in enumerate(waiting):
            group = begun.get(trial.number)
            if group is None:
                others = [
                    each
                    for each in waiting[index + 1 :]
                    if trial.number in common and common.get(each.number) == common[trial.number]
                ]
                yield Plan([trial, *others[: self._size - 1]])
            elif group.folder not in seen:
                seen.add(group.folder)
                keys = [run.key for run in group.runs if names.get(run.key) == group.folder.name]
                members = [owners[key] for key in keys if key in owners]
                if not any(each.state is TrialState.RUNNING for each in members):
                    yield Plan([each for each in members if each.state is TrialState.WAITING], group)

    def _begun(self, trial: FrozenTrial, names: dict[str, str | None]) -> Group | None:
        """Return the group in which a run goes on: that of its last process, if it has a saved state here."""
        name = names.get(trial.user_attrs[KEY])
        if name is None or not (self._folder / FOLDER / name / GROUP_RUNS).is_file():
            return None
        group = Group.read(self._folder / FOLDER / name)
        return group if run_of(trial) in group.runs and StateStore(group.states).steps() else None

    def _has_state(self, trial: FrozenTrial) -> bool:
        run = run_of(trial)
        return has_state(run, run_folder(self._logs, self._study, run))


def _is_dissolved(attempts: Sequence[FrozenTrial]) -> bool:
    """Return whether one of a run's trials was in a population that was dissolved."""
    return any(trial.user_attrs.get(OUTCOME, "").startswith(DISSOLVED) for trial in attempts)


def _as_json(runs: Sequence[Run]) -> bytes:
    return json.dumps([asdict(run) for run in runs]).encode()


def _names(trials: Sequence[FrozenTrial]) -> dict[str, str | None]:
    """Return the name of the group in which each run was last trained, by the run's key; None for a run alone."""
    names = {}
    for trial in sorted(trials, key=lambda trial: trial.number):
        # A process that has just taken a trial has not set its attributes yet
        if {WORKER, POPULATION} & trial.user_attrs.keys():
            names[trial.user_attrs[KEY]] = trial.user_attrs.get(POPULATION, {}).get("name")
    return names


def _annotate(ledger: Ledger, claim: Claim, group: Group) -> bool:
    """Set the group of a trial, and return whether it is still this process's own."""
    try:
        ledger.annotate(claim, POPULATION, group.mark)
    except TrialLostError:
        return False
    return True
