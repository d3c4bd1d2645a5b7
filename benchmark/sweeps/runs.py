"""The runs of a sweep, and their description."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from benchmark.common.records import configuration_in_words, run_key
from benchmark.sweeps.sweep_files import Hyperparams
from benchmark.sweeps.validation import SweepError


@dataclass(frozen=True)
class Run:
    """
    One configuration with one seed.

    :param method: the method's name
    :param task: the environment, as it is registered
    :param settings: the values of the axes
    :param seed: the seed
    :param algo: the algorithm's name in rl_zoo3
    :param hyperparams: all hyperparameters that are not the algorithm's defaults, as in rl_zoo3's YAML files
    :param steps: environment steps
    :param evaluation_interval: environment steps between two evaluations
    :param evaluation_episodes: episodes of each evaluation
    :param checkpoint_interval: environment steps between two saved training states
    :param gym_packages: modules to import, which register the environment
    """

    method: str
    task: str
    settings: dict[str, Any]
    seed: int
    algo: str
    hyperparams: Hyperparams
    steps: int
    evaluation_interval: int
    evaluation_episodes: int
    checkpoint_interval: int
    gym_packages: list[str] = field(default_factory=list)

    @classmethod
    def from_fields(cls, described: Mapping[str, Any], place: object) -> "Run":
        """
        Return the run that was described by ``dataclasses.asdict``.

        :param described: the values of its fields
        :param place: the file or the trial that holds them, for the error
        :return: the run
        :raises SweepError: if they are not the fields of a run, as another version of sb3-cgp may have had others
        """
        try:
            return cls(**described)
        except TypeError as error:
            remedy = "Go on with the version that began the study, or begin another one by --study"
            raise SweepError(place, "", f"holds a run of another version of sb3-cgp ({error}). {remedy}") from error

    @property
    def configuration(self) -> str:
        """The method and the values of the axes, as text."""
        return configuration_in_words(self.method, self.settings)

    @property
    def key(self) -> str:
        """A text that no other run of its study has."""
        return run_key(self.method, self.settings, self.task, self.seed)


def overview(runs: Iterable[Run], methods: Iterable[str], tasks: Iterable[str]) -> dict[str, Any]:
    """
    Describe the runs of a sweep.

    :param runs: the runs, some perhaps more than once
    :param methods: all methods of the sweep, in order
    :param tasks: all environments of the sweep, in order
    :return: the methods, tasks and seeds of the runs, the number of seeds of each method, that of all runs, and the
        hyperparameters of each configuration, on each task if they differ
    """
    by_key = {run.key: run for run in runs}
    ordered = sorted(by_key.values(), key=lambda run: run.configuration)
    of_configurations: dict[str, dict[str, dict[str, Any]]] = {}
    for run in ordered:
        of_configurations.setdefault(run.configuration, {})[run.task] = {"algo": run.algo, **run.hyperparams}
    configurations: dict[str, dict[str, Any]] = {}
    for name, by_task in of_configurations.items():
        entries = list(by_task.values())
        is_one = all(entry == entries[0] for entry in entries)
        configurations |= {name: entries[0]} if is_one else {f"{name},{task}": entry for task, entry in by_task.items()}
    present = [method for method in methods if any(run.method == method for run in ordered)]
    return {
        "methods": present,
        "tasks": [task for task in tasks if any(run.task == task for run in ordered)],
        "seeds": sorted({run.seed for run in ordered}),
        "seeds_of_methods": {method: len({run.seed for run in ordered if run.method == method}) for method in present},
        "runs_planned": len(ordered),
        "configurations": configurations,
    }


def checkpoint_interval(steps: int) -> int:
    """
    Return the default interval between two saved training states.

    :param steps: environment steps of a run
    :return: a tenth of the run, from 1,000 to 10,000 environment steps
    """
    return min(max(steps // 10, 1_000), 10_000)
