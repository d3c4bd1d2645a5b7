"""
Sweeps as data: the files of ``hyperparams/sweeps`` with what a command line changes, and the runs that follow from them.

A file's keys are the fields of :class:`~benchmark.sweeps.sweep_files.SweepFile`.
"""

import difflib
import inspect
import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rl_zoo3 import ALGOS

from benchmark.common.records import configuration_in_words, run_key
from benchmark.sweeps.random_actions import NAME as RANDOM
from benchmark.sweeps.sweep_files import Hyperparams, Inclusion, Method, SweepError, SweepFile, read_yaml, validated
from sb3_cgp.zoo.registration import hyperparams_folder

METHODS_FILE = "methods.yml"
# What rl_zoo3 takes from an entry of its YAML files for itself, but for the steps; the rest are the algorithm's arguments
ZOO_HYPERPARAMS = (
    *("callback", "env_kwargs", "env_wrapper", "frame_stack", "monitor_kwargs", "n_envs", "noise_std", "noise_type"),
    *("normalize", "policy_kwargs", "vec_env_wrapper"),
)


@dataclass(frozen=True)
class Run:
    """
    One configuration with one seed.

    :param method: the method's name
    :param task: the environment
    :param settings: the values of the axes
    :param seed: the seed
    :param algo: the algorithm's name in rl_zoo3
    :param hyperparams: hyperparameters, as in rl_zoo3's YAML files
    :param tuned: whether they come on top of those of the algorithm's YAML file
    :param steps: environment steps
    :param evaluation_interval: environment steps between two evaluations
    :param evaluation_episodes: episodes of each evaluation
    :param checkpoint_interval: environment steps between two states to go on from
    """

    method: str
    task: str
    settings: dict[str, Any]
    seed: int
    algo: str
    hyperparams: Hyperparams
    tuned: bool
    steps: int
    evaluation_interval: int
    evaluation_episodes: int
    checkpoint_interval: int

    @property
    def configuration(self) -> str:
        """The method and the values of the axes, in words."""
        return configuration_in_words(self.method, self.settings)

    @property
    def key(self) -> str:
        """What tells the run from all others of its study."""
        return run_key(self.method, self.settings, self.task, self.seed)


def overview(runs: Iterable[Run], methods: Iterable[str], tasks: Iterable[str]) -> dict[str, Any]:
    """
    Say what runs there are.

    :param runs: the runs, some perhaps more than once
    :param methods: all methods that they may be of, in order
    :param tasks: all environments that they may be of, in order
    :return: the methods, tasks and seeds that they are of, their number, and the hyperparameters of each configuration
    """
    by_key = {run.key: run for run in runs}
    ordered = sorted(by_key.values(), key=lambda run: run.configuration)
    return {
        "methods": [method for method in methods if any(run.method == method for run in ordered)],
        "tasks": [task for task in tasks if any(run.task == task for run in ordered)],
        "seeds": sorted({run.seed for run in ordered}),
        "runs_planned": len(ordered),
        "configurations": {run.configuration: {"algo": run.algo, **run.hyperparams} for run in ordered},
    }


@dataclass(frozen=True)
class Sweep:
    """
    A sweep, with what was changed of its file.

    :param name: the sweep's name
    :param file: what the file says, changed
    :param methods: the methods by name
    :param changes: what was changed, in words
    """

    name: str
    file: SweepFile
    methods: dict[str, Method]
    changes: list[str] = field(default_factory=list)

    @property
    def seeds(self) -> list[int]:
        """The seeds."""
        return list(range(self.file.seeds)) if isinstance(self.file.seeds, int) else self.file.seeds

    def runs(self) -> list[Run]:
        """
        List the runs: each seed's together, so that a sweep that is stopped early has all configurations.

        :return: the runs
        """
        return [
            self._run(method, task, settings, seed)
            for seed in self.seeds
            for task in self.file.tasks
            for settings in self._combinations()
            for method in self.methods
        ]

    def _combinations(self) -> Iterator[dict[str, Any]]:
        axes = self.file.axes
        for values in itertools.product(*(axis.values for axis in axes.values())):
            settings = dict(zip(axes, values, strict=True))
            if not any(left_out.items() <= settings.items() for left_out in self.file.exclude if left_out):
                yield settings

    def _run(self, method: str, task: str, settings: dict[str, Any], seed: int) -> Run:
        file = self.file
        hyperparams = self.methods[method].hyperparams
        if "learning_starts" in hyperparams:
            # Shortened runs are to learn, too
            hyperparams = hyperparams | {"learning_starts": min(hyperparams["learning_starts"], file.steps // 10)}
        hyperparams = hyperparams | file.hyperparams
        for axis, value in settings.items():
            hyperparams = hyperparams | file.axes[axis].hyperparams(axis, value, method)
        return Run(
            method,
            task,
            settings,
            seed,
            self.methods[method].algo,
            hyperparams,
            self.methods[method].tuned,
            file.steps,
            file.evaluation_interval,
            file.evaluation_episodes,
            file.checkpoint_interval or min(max(file.steps // 10, 1_000), 10_000),
        )


def sweeps_folder() -> Path:
    """
    Find the folder of the paper's sweeps.

    :return: the folder
    """
    return hyperparams_folder() / "sweeps"


def find_sweep_file(name: str) -> Path:
    """
    Find a sweep's file.

    :param name: one of the paper's sweeps, such as "e3", or the path of a file
    :return: the file
    :raises SweepError: if there is none
    """
    path = Path(name) if name.endswith((".yml", ".yaml")) else sweeps_folder() / f"{name}.yml"
    if not path.is_file() or path.name == METHODS_FILE:
        known = sorted(each.stem for each in sweeps_folder().glob("*.yml") if each.name != METHODS_FILE)
        raise SweepError(name, "", f"no such sweep: must be one of {', '.join(known)}, or the path of a .yml file")
    return path


def included_sweeps(name: str) -> list[str]:
    """
    List the sweeps that a name stands for.

    :param name: a sweep, or a file that includes others
    :return: the sweeps' names: its own, or those that it includes
    :raises SweepError: if there is no such sweep, or its file is wrong
    """
    path = find_sweep_file(name)
    content = read_yaml(path)
    return validated(Inclusion, content, path).includes if "includes" in content else [name]


def load_sweep(name: str, overrides: dict[str, Any] | None = None, methods: Sequence[str] | None = None) -> Sweep:
    """
    Read a sweep's file.

    :param name: one of the paper's sweeps, or the path of a file
    :param overrides: fields of the file to replace; hyperparameters are added to the file's, and with other steps the
        evaluation interval is a twentieth of them unless it is replaced, too
    :param methods: the methods to take, of those that the file names
    :return: the sweep
    :raises SweepError: if the file or an override is wrong: it names the place, the key and what is allowed
    """
    path = find_sweep_file(name)
    content = read_yaml(path)
    # First the file alone, so that a mistake is said to be where it is
    file = validated(SweepFile, content, path)
    overrides = {key: value for key, value in (overrides or {}).items() if value is not None}
    if "steps" in overrides:
        overrides = overrides | {"evaluation_interval": overrides.get("evaluation_interval", max(overrides["steps"] // 20, 1))}
    changed = overrides.get("hyperparams", {})
    changes = [f"{key} {value}" for key, value in overrides.items()]
    if "hyperparams" in overrides:
        overrides = overrides | {"hyperparams": file.hyperparams | overrides["hyperparams"]}
    if overrides:
        file = validated(SweepFile, content | overrides, "the command line")
    known = file.methods if isinstance(file.methods, dict) else _named_methods(path, file.methods)
    chosen = list(methods or known)
    for method in chosen:
        if method not in known:
            raise SweepError("the command line", "methods", f"{method!r} must be one of {', '.join(known)}")
    if methods:
        changes.append(f"methods {', '.join(chosen)}")
    sweep = Sweep(path.stem, file, {method: known[method] for method in chosen}, changes)
    _check_hyperparams(path, sweep, changed)
    return sweep


def _check_hyperparams(path: Path, sweep: Sweep, changed: Hyperparams) -> None:
    """See that each method takes what is set for it, before hours are spent."""
    for run in {run.configuration: run for run in sweep.runs()}.values():
        allowed = {*inspect.signature(ALGOS[run.algo]).parameters, *ZOO_HYPERPARAMS} - {"env", "seed", "device", "verbose"}
        for name in run.hyperparams:
            if name not in allowed and run.algo != RANDOM:
                is_the_methods = isinstance(sweep.file.methods, list) and name in sweep.methods[run.method].hyperparams
                place = "the command line" if name in changed else _methods_file(path) if is_the_methods else path
                close = ", ".join(difflib.get_close_matches(name, allowed, n=3) or sorted(allowed))
                raise SweepError(place, name, f"no hyperparameter of {run.method} ({run.algo}), which must be one of {close}")


def _methods_file(path: Path) -> Path:
    beside = path.parent / METHODS_FILE
    return beside if beside.is_file() else sweeps_folder() / METHODS_FILE


def _named_methods(path: Path, names: list[str]) -> dict[str, Method]:
    source = _methods_file(path)
    known = {name: validated(Method, entry, source, name) for name, entry in read_yaml(source).items()}
    for name in names:
        if name not in known:
            raise SweepError(path, "methods", f"{name!r} must be one of {', '.join(known)} ({source}), or be defined here")
    return {name: known[name] for name in names}
