"""
Sweeps as data: the files of ``hyperparams/sweeps`` with the changes of a command line, and the runs that follow from them.

A file's keys are the fields of :class:`~benchmark.sweeps.sweep_files.SweepFile`.
"""

import itertools
import json
import math
import re
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from huggingface_sb3 import EnvironmentName

from benchmark.common.sweep_names import METHODS_FILE, problem_of, sweep_names, sweep_path, sweeps_folder
from benchmark.common.zoo import EVALUATIONS_PER_RUN, shortened_warm_up, without_defaults
from benchmark.sweeps.entries import base_entry
from benchmark.sweeps.hyperparameters import problems
from benchmark.sweeps.runs import Run, checkpoint_interval
from benchmark.sweeps.sweep_files import Hyperparams, Inclusion, Method, Packages, SweepFile
from benchmark.sweeps.validation import SweepError, read_yaml, validated

# The names of this project's sweeps
OWN_NAMES = re.compile(r"e\d+(-.*)?")
# Fields that the page takes from the runs: a later command may add some, and names its own alone
RECOMPUTED = ("tasks", "seeds")


@dataclass(frozen=True)
class Sweep:
    """
    A sweep, with the changes to its file.

    :param name: the sweep's name
    :param file: the content of the file, with the changes
    :param methods: the methods by name
    :param changes: the changes that have an effect, as text, without tasks, seeds and methods, which are those of the runs
    :param path: the file; None for a sweep without one
    :param is_shortened: whether the runs are shorter than the file says
    :param given: the hyperparameters for all methods that the command line sets, which are in the file's, too
    """

    name: str
    file: SweepFile
    methods: dict[str, Method]
    changes: list[str] = field(default_factory=list)
    path: Path | None = None
    is_shortened: bool = False
    given: Hyperparams = field(default_factory=dict)

    @property
    def seeds(self) -> list[int]:
        """The seeds."""
        return list(range(self.file.seeds)) if isinstance(self.file.seeds, int) else self.file.seeds

    @property
    def shared(self) -> dict[str, dict[str, Any]]:
        """What all methods have in common, as JSON has it: the hyperparameters that have an effect, and what the axes set."""
        file = self.file
        axes = {name: axis.model_dump() for name, axis in file.axes.items()}
        hyperparams = {key: value for key, value in file.hyperparams.items() if not self._is_replaced(key)}
        return json.loads(json.dumps({"hyperparams": hyperparams, "axes": axes}))

    def _is_replaced(self, key: str) -> bool:
        """Return whether axes, or all methods, set a hyperparameter of every method of the file, also of those not chosen."""
        return self.all_methods_set(key) or any(
            all(key in axis.hyperparams(name, value, method) for value in axis.values for method in self.file.methods)
            for name, axis in self.file.axes.items()
        )

    def all_methods_set(self, key: str) -> bool:
        """
        Return whether each method, all defined in the file, has a hyperparameter of its own, which goes before the file's.

        :param key: the hyperparameter
        :return: whether each has; False if it was given on the command line, which goes before both
        """
        methods = self.file.methods
        is_given = key in self.given
        return isinstance(methods, dict) and not is_given and all(key in each.hyperparams for each in methods.values())

    def runs(self) -> list[Run]:
        """
        List the runs, ordered by seed, so that a sweep that is stopped early has run all configurations.

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
        # The steps are the sweep's, and its own callback saves states
        entry = {name: value for name, value in self._entries[method, task].items() if name not in ("n_timesteps", "callback")}
        own = self.methods[method].hyperparams
        hyperparams = entry | own | self._warm_up(method, task)
        # Methods of the file itself are more special than what it has for all of them
        special = {key: hyperparams[key] for key in own} if isinstance(file.methods, dict) else {}
        hyperparams = hyperparams | file.hyperparams | special | self.given
        for axis, value in settings.items():
            hyperparams = hyperparams | file.axes[axis].hyperparams(axis, value, method)
        return Run(
            method,
            task,
            settings,
            seed,
            self.methods[method].algo,
            hyperparams,
            file.steps,
            file.evaluation_interval,
            file.evaluation_episodes,
            file.checkpoint_interval or checkpoint_interval(file.steps),
            file.gym_packages,
        )

    @cached_property
    def _entries(self) -> dict[tuple[str, str], Hyperparams]:
        """The entry that each tuned method starts from on each task, read once; empty for the other methods."""
        try:
            return {
                (name, task): base_entry(method.algo, task) if method.tuned else {}
                for name, method in self.methods.items()
                for task in self.file.tasks
            }
        except ValueError as error:
            raise SweepError(self.path or self.name, "methods", f"`tuned: true` needs an entry: {error}") from error

    def _warm_up(self, method: str, task: str) -> dict[str, int]:
        """Return the number of random steps at the start, where it replaces one that is meant for longer runs."""
        algo, own = self.methods[method].algo, self.methods[method].hyperparams
        entry = self._entries[method, task]
        if "learning_starts" in own:
            # The file of named methods serves runs of all lengths
            is_meant = isinstance(self.file.methods, dict) and not self.is_shortened
        else:
            is_meant = self.file.steps >= float(entry.get("n_timesteps", math.inf))
        return {} if is_meant else shortened_warm_up(algo, entry | own, self.file.steps)

    def shortened_warm_up(self) -> dict[str, int]:
        """
        Return the number of random steps at the start that is in place of a method's own, of the first run that has it.

        :return: ``learning_starts``; nothing if every run has the number of its method, of its axis or of the command line
        """
        for run in self.runs():
            warm_up = self._warm_up(run.method, run.task)
            if warm_up and warm_up.items() <= run.hyperparams.items():
                return warm_up
        return {}


def difference(was: dict[str, dict[str, Any]] | None, now: dict[str, dict[str, Any]]) -> tuple[str, str] | None:
    """
    Return the first hyperparameter or axis of all methods that differs from that of an earlier command.

    :param was: :attr:`Sweep.shared` of an earlier command; None if it was not recorded
    :param now: the same of this command
    :return: the first key that differs, and how; None if none does
    """
    if was is None:
        return None
    for part in now:
        for key in {**was[part], **now[part]}:
            before, after = was[part].get(key, "not given"), now[part].get(key, "not given")
            if before != after:
                return f"{part}.{key}", f"was {before!r} and is now {after!r}"
    return None


def find_sweep_file(name: str) -> Path:
    """
    Return a sweep's file.

    :param name: one of the paper's sweeps, such as "e3", or the path of a file
    :return: the file
    :raises SweepError: if there is none
    """
    problem = problem_of(name)
    if problem is not None:
        raise SweepError(name, "", problem)
    return sweep_path(name)


def experiments_in_words() -> str:
    """
    Return a list of the sweeps that have names.

    :return: name and title of each, a line each, without those whose files are wrong
    """
    lines = ["sweeps:"]
    for path in map(sweep_path, sweep_names()):
        # A wrong file ends only the commands that take it, which say what is wrong
        with suppress(SweepError):
            match read_yaml(path):
                case {"title": title, "includes": list(names)}:
                    lines.append(f"  {path.stem:<14} {title} = {', '.join(map(str, names))}")
                # YAML reads 1.0e+6 as a float
                case {"title": title, "steps": int(steps) | float(steps)}:
                    lines.append(f"  {path.stem:<14} {title}, {steps:,.0f} steps")
    return "\n".join(lines)


def included_sweeps(name: str) -> list[str]:
    """
    Return the sweeps that a name stands for.

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
    :param overrides: fields of the file to replace; hyperparameters and packages are added to the file's, and with other steps
        the evaluation interval is a twentieth of them unless it is replaced, too
    :param methods: the methods to take, of those that the file names
    :return: the sweep
    :raises SweepError: if the file or an override is wrong; it names the place, the key and what is allowed
    """
    path = find_sweep_file(name)
    if OWN_NAMES.fullmatch(path.stem) and path.resolve().parent != sweeps_folder():
        consequence = "its runs count as data on the paper's claims. Rename the file if they are not"
        print(f"Warning: {path} has the name of one of this project's sweeps: {consequence}.", file=sys.stderr)
    content = read_yaml(path)
    overrides = {key: value for key, value in (overrides or {}).items() if value is not None}
    packages = validated(Packages, {"gym_packages": overrides.pop("gym_packages", [])}, "the command line").gym_packages
    # First the file alone, so that the error names the place of a mistake
    file = validated(SweepFile, content, path)
    own_steps = file.steps
    if packages:
        overrides["gym_packages"] = [*file.gym_packages, *packages]
    if "steps" in overrides:
        overrides = overrides | {
            "evaluation_interval": overrides.get("evaluation_interval", max(overrides["steps"] // EVALUATIONS_PER_RUN, 1))
        }
    changed = overrides.get("hyperparams", {})
    described = {key: value for key, value in overrides.items() if key not in RECOMPUTED}
    if "hyperparams" in overrides:
        overrides = overrides | {"hyperparams": file.hyperparams | overrides["hyperparams"]}
    if overrides:
        file = validated(SweepFile, content | overrides, "the command line")
    known = file.methods if isinstance(file.methods, dict) else _named_methods(path, file.methods)
    chosen = list(methods or known)
    for method in chosen:
        if method not in known:
            raise SweepError("the command line", "methods", f"{method!r} must be one of {', '.join(known)}")
    chosen_methods = {method: known[method] for method in chosen}
    sweep = Sweep(path.stem, file, chosen_methods, path=path, is_shortened=file.steps < own_steps, given=changed)
    if not sweep.runs():
        raise SweepError(path, "exclude", "leaves no combination of the axes' values")
    replaced = _replaced_hyperparams(sweep)
    for key, axes in replaced.items():
        place = "--set" if key in changed else path
        print(f"Warning: {place}: {key} has no effect, as {axes} sets it in every run. Remove it.", file=sys.stderr)
    effective = {key: value for key, value in changed.items() if key not in replaced}
    described = {key: effective if key == "hyperparams" else value for key, value in described.items()}
    changes = [f"{key} {value}" for key, value in described.items() if key != "hyperparams" or value]
    sweep = replace(sweep, changes=changes)
    for run in {run.configuration: run for run in sweep.runs()}.values():
        for key, problem in problems(run.method, run.algo, run.hyperparams):
            raise SweepError(_origin(sweep, path, run, key, changed), key, problem)
    for copies in _copies(sweep):
        text = "have the same hyperparameters, so that their runs are the same"
        print(f"Warning: {path}: {' and '.join(copies)} {text}.", file=sys.stderr)
    return sweep


def _copies(sweep: Sweep) -> list[tuple[str, ...]]:
    """Return the configurations that have the same hyperparameters on a task, those of the same together."""
    alike: dict[tuple[str, str], dict[str, None]] = {}
    for run in sweep.runs():
        same = run.task, without_defaults({"algo": run.algo, **run.hyperparams})
        alike.setdefault(same, {})[run.configuration] = None
    return list(dict.fromkeys(tuple(names) for names in alike.values() if len(names) > 1))


def _replaced_hyperparams(sweep: Sweep) -> dict[str, str]:
    """Return the hyperparameters for all methods that axes or the methods replace in every run, with these in words."""
    file, runs = sweep.file, sweep.runs()
    found = {}
    for key in file.hyperparams:
        setting = [
            [axis for axis, value in run.settings.items() if key in file.axes[axis].hyperparams(axis, value, run.method)]
            for run in runs
        ]
        if sweep.all_methods_set(key):
            found[key] = "each method"
        elif all(setting):
            found[key] = " or ".join(f"the axis {axis!r}" for axis in dict.fromkeys(itertools.chain(*setting)))
    return found


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


def study_name(prefix: str, given: str | None, tasks: Iterable[str] | None = None) -> str:
    """
    Return the name of a study, which is that of its folders, too.

    :param prefix: the beginning of the name that a study has by default
    :param given: the name that the user gave; None for the default
    :param tasks: environments, which the default name ends with, as rl_zoo3 names their folders; None for no environment
    :return: the name
    :raises SweepError: if the given name cannot be a folder's
    """
    if given is None:
        return "-".join([prefix, *map(EnvironmentName, tasks or [])])
    if given in ("", ".", "..") or "/" in given or "\\" in given:
        raise SweepError("the command line", "--study", f"{given!r} must be the name of a folder, without a slash")
    return given


def _origin(sweep: Sweep, path: Path, run: Run, key: str, changed: Hyperparams) -> object:
    """Return the place that a hyperparameter of a run comes from."""

    def sets(hyperparams: Hyperparams) -> bool:
        return key in hyperparams and hyperparams[key] == run.hyperparams[key]

    if sets(changed):
        return "the command line"
    return (
        _methods_file(path) if isinstance(sweep.file.methods, list) and sets(sweep.methods[run.method].hyperparams) else path
    )
