"""The records of a sweep's ended runs, a line of JSON for each."""

import itertools
import json
import math
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from benchmark.common.files import parse_json, read_json
from sb3_cgp.common.files import write_atomically

# The files of a study's folder: its records, and its description
RUNS = "runs.jsonl"
STUDY = "study.json"
# The keys of a description in all versions
DESCRIBED = (
    *("title", "experiment", "axes", "steps", "evaluation_interval", "evaluation_episodes", "settings_in_words"),
    *("methods", "tasks", "seeds", "runs_planned", "commands"),
)
REWRITE = (
    "give the command of its sweep again, which writes it anew from the study's storage; without that, move the folder away"
)
REMEDY = f"Move it away, and {REWRITE}."
# Of the evaluation of a final model, the same for all runs on a task. The seed is far from those that people train with:
# rl_zoo3 gives a run's own seed to the environments of its training.
FINAL_EPISODES, EVALUATION_SEED = 20, 10_000


def configuration_in_words(method: str, settings: dict[str, Any]) -> str:
    """
    Return the name of a configuration.

    :param method: the method
    :param settings: the values of the axes, by axis
    :return: the name
    """
    return ",".join([method, *(f"{axis}={value}" for axis, value in sorted(settings.items()))])


def run_key(method: str, settings: dict[str, Any], task: str, seed: int) -> str:
    """
    Return a name that no other run of the study has.

    :param method: the method
    :param settings: the values of the axes, by axis
    :param task: the environment
    :param seed: the seed
    :return: the name
    """
    return f"{configuration_in_words(method, settings)},{task},seed={seed}"


@dataclass(frozen=True)
class Record:
    """
    A run that has ended: one configuration, one seed.

    :param experiment: the sweep's name, such as "e3"
    :param method: the method's name, such as "CGP-Online"
    :param task: the environment
    :param settings: the values of the sweep's axes, by axis
    :param seed: the seed
    :param steps: environment steps that were planned
    :param timesteps: environment steps at each evaluation, ascending
    :param returns: mean return of each evaluation's episodes
    :param final: mean return of the final model over ``FINAL_EPISODES`` episodes; None for a run that failed
    :param error: the error of a failed run; None for other runs
    :param seconds: wall-clock time of all attempts together; None where it is not known
    :param processor_seconds: time on the processor of all attempts and threads together; None where it was not measured.
        Of a run in a population, the process's time divided by the number of agents
    :param population: number of agents that were trained in one process with it, itself included; 1 for a run alone
    :param processors: the processor that trained it, several if it was continued on others; none where they were not recorded
    """

    __pydantic_config__: ClassVar = {"strict": True, "extra": "forbid"}

    experiment: str
    method: str
    task: str
    settings: dict[str, Any]
    seed: int
    steps: int
    timesteps: list[int]
    returns: list[float]
    final: float | None
    error: str | None
    seconds: float | None
    processor_seconds: float | None = None
    population: int = 1
    processors: list[str] = field(default_factory=list)

    @property
    def key(self) -> str:
        """A name that no other run of the study has."""
        return run_key(self.method, self.settings, self.task, self.seed)


def write_records(folder: Path, records: Iterable[Record]) -> None:
    """
    Write the records of a study.

    :param folder: the study's folder
    :param records: the runs
    """
    lines = sorted(json.dumps(asdict(record)) for record in records)
    write_atomically(folder / RUNS, "".join(f"{line}\n" for line in lines).encode())


def read_records(folder: Path, steps: int | None = None) -> list[Record]:
    """
    Read the records of a study.

    :param folder: the study's folder
    :param steps: the steps of its runs by its description; None if they are not to be compared
    :return: the runs, each once, also where lines of the file are equal
    :raises FileNotFoundError: if it holds none
    :raises ValueError: if one is damaged, or two differ on one run; it names the file, the line and the remedy
    """
    # The extra of sweeps has it, which `make train` does not need
    from pydantic import TypeAdapter, ValidationError

    kind = TypeAdapter(Record)
    path = folder / RUNS
    records: dict[str, tuple[int, Record]] = {}
    for number, line in enumerate(path.read_bytes().splitlines(), start=1):
        parse_json(line, path, remedy=REMEDY, first_line=number)
        try:
            record = kind.validate_json(line)
            found = list(_contradictions(record, steps))
        except ValidationError as error:
            found = list(map(_in_words, error.errors()))
        if found:
            raise ValueError(f"{path}, line {number}, is no record of a run: {'; '.join(found)}. {REMEDY}")
        first, other = records.setdefault(record.key, (number, record))
        # As text, in which NaN equals itself
        if str(other) != str(record):
            raise ValueError(f"{path}, lines {first} and {number}, are different records of the run {record.key}. {REMEDY}")
    return [record for _, record in records.values()]


def _contradictions(record: Record, steps: int | None) -> Iterator[str]:
    if len(record.timesteps) != len(record.returns):
        yield f"returns: {len(record.returns)} must be as many as timesteps, {len(record.timesteps)}"
    if any(after <= before for before, after in itertools.pairwise(record.timesteps)):
        yield "timesteps: must ascend"
    if (record.final is None) == (record.error is None):
        yield f"final: {record.final} and error: {record.error!r}: one of them must be null, and the other one not"
    if record.final is not None and not math.isfinite(record.final):
        yield f"final: {record.final} must be finite, or null with an error"
    if steps not in (None, record.steps):
        yield f"steps: {record.steps} must be those of {STUDY}, {steps}"


def _in_words(error: Any) -> str:
    given = "" if isinstance(error["input"], dict) else f" (it is {error['input']!r:.60})"
    return f"{'.'.join(map(str, error['loc']))}: {error['msg']}{given}"


def entries_by_task(description: dict[str, Any]) -> dict[tuple[str, str], dict[str, Any]]:
    """
    Return the hyperparameters of a study's configurations on each of its tasks.

    :param description: the study's description, whose "configurations" name a task only where the tasks' entries differ
    :return: hyperparameters by the configuration in words and the task
    """
    found: dict[tuple[str, str], dict[str, Any]] = {}
    tasks = description.get("tasks", [])
    for name, entry in description.get("configurations", {}).items():
        own = [task for task in tasks if name.endswith(f",{task}")]
        found |= {(name.removesuffix(f",{task}"), task): entry for task in own or tasks}
    return found


def read_description(folder: Path, *further: str) -> dict[str, Any]:
    """
    Read the description of a study.

    :param folder: the study's folder
    :param further: keys that it must have beside those of all versions
    :return: the description
    :raises FileNotFoundError: if it has none
    :raises ValueError: if it is damaged; it names the file and the remedy
    """
    return read_json(folder / STUDY, (*DESCRIBED, *further), REMEDY)
