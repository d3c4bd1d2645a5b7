"""
Sweeps as data: what a file of ``hyperparams/sweeps`` says, checked, and the runs that follow from it.

A file's keys are the fields of :class:`SweepFile`; ``benchmark/README.md`` shows how to write one.
"""

import difflib
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from string import Template
from typing import Annotated, Any

import gymnasium as gym
import yaml
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, PositiveInt, ValidationError, model_validator
from rl_zoo3 import ALGOS

from benchmark.random_actions import register_random_actions
from sb3_cgp.zoo import hyperparams_folder, register

METHODS_FILE = "methods.yml"
# Of the final model
FINAL_EPISODES = 20

Hyperparams = dict[str, Any]
# What Optuna can tell from each other
Value = bool | int | float | str | None


class SweepError(ValueError):
    """
    A sweep's file, or what was to be changed of it, is wrong.

    :param place: the file, or the option
    :param key: what is wrong there
    :param problem: how, and what is allowed
    """

    def __init__(self, place: object, key: str, problem: str):
        super().__init__(f"{place}: {key}: {problem}" if key else f"{place}: {problem}")


def _known_algorithm(name: str) -> str:
    register()
    register_random_actions()
    if name not in ALGOS:
        raise ValueError(f"must be one of {', '.join(sorted(ALGOS))}")
    return name


def known_task(name: str) -> str:
    """
    See that an environment is registered.

    :param name: the environment
    :return: the name
    :raises ValueError: if it is not registered
    """
    if name not in gym.registry:
        close = difflib.get_close_matches(name, list(gym.registry), n=3)
        raise ValueError("must be a registered environment" + (f", such as {', '.join(close)}" if close else ""))
    return name


class _Strict(BaseModel):
    """Data with no keys but those that are declared."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Method(_Strict):
    """
    A method to compare.

    :param algo: the algorithm's name in rl_zoo3
    :param hyperparams: all hyperparameters that are not the algorithm's defaults, as in rl_zoo3's YAML files
    :param tuned: start from the entry that the task has in rl_zoo3's (or our) YAML file of the algorithm
    """

    algo: Annotated[str, AfterValidator(_known_algorithm)]
    hyperparams: Hyperparams = {}
    tuned: bool = False


class Axis(_Strict):
    """
    What is varied.

    :param values: a list of values, or names of values with the hyperparameters that each stands for
    :param sets: the hyperparameters that are set, where ``$value`` stands for the value; for a list of values, by
        default the hyperparameter of the axis's own name
    :param sets_for: the same for single methods, in place of ``sets``
    """

    values: Annotated[list[Value], Field(min_length=1)] | Annotated[dict[str, Hyperparams], Field(min_length=1)]
    sets: Hyperparams | None = None
    sets_for: dict[str, Hyperparams] = {}

    @model_validator(mode="after")
    def _check(self) -> "Axis":
        if isinstance(self.values, dict):
            if self.sets is not None or self.sets_for:
                raise ValueError("`sets` and `sets_for` are for a list of values: named values say what they set themselves")
        elif len(set(map(repr, self.values))) < len(self.values):
            raise ValueError("`values` must differ from each other")
        return self

    def hyperparams(self, name: str, value: Any, method: str) -> Hyperparams:
        """
        Tell what a value stands for.

        :param name: the axis
        :param value: one of its values
        :param method: the method
        :return: hyperparameters
        """
        if isinstance(self.values, dict):
            return self.values[value]
        sets = self.sets_for.get(method, self.sets if self.sets is not None else {name: "$value"})
        return {key: _fill(template, value) for key, template in sets.items()}


def _fill(template: Any, value: Any) -> Any:
    if template == "$value":
        return value
    return Template(template).substitute(value=value) if isinstance(template, str) else template


class SweepFile(_Strict):
    """
    A sweep as its file says it.

    :param title: what it is, in a few words
    :param methods: names from ``methods.yml`` beside the file, or methods of its own by name
    :param tasks: environments
    :param steps: environment steps of each run
    :param seeds: how many seeds, from 0, or a list of seeds
    :param evaluation_interval: environment steps between two evaluations
    :param evaluation_episodes: episodes of each evaluation
    :param checkpoint_interval: environment steps between two states to go on from; by default a tenth of the run,
        from 1,000 to 10,000
    :param hyperparams: hyperparameters for all methods
    :param axes: what is varied, by name
    :param exclude: combinations of the axes' values to leave out
    """

    title: str
    methods: Annotated[list[str], Field(min_length=1)] | Annotated[dict[str, Method], Field(min_length=1)]
    tasks: Annotated[list[Annotated[str, AfterValidator(known_task)]], Field(min_length=1)]
    steps: PositiveInt
    seeds: PositiveInt | Annotated[list[Annotated[int, Field(ge=0, lt=2**32)]], Field(min_length=1)]
    evaluation_interval: PositiveInt
    evaluation_episodes: PositiveInt = 10
    checkpoint_interval: PositiveInt | None = None
    hyperparams: Hyperparams = {}
    axes: dict[str, Axis] = {}
    exclude: list[dict[str, Any]] = []

    @model_validator(mode="after")
    def _check(self) -> "SweepFile":
        for name, axis in self.axes.items():
            for method in axis.sets_for:
                if method not in self.methods:
                    raise ValueError(f"`axes.{name}.sets_for` names {method!r}, but must name one of {list(self.methods)}")
        for left_out in self.exclude:
            for name, value in left_out.items():
                if name not in self.axes:
                    raise ValueError(f"`exclude` names {name!r}, but must name one of {list(self.axes)}")
                if value not in self.axes[name].values:
                    raise ValueError(f"`exclude` has {name} {value!r}, but must have one of {list(self.axes[name].values)}")
        return self


class Inclusion(_Strict):
    """
    A file that stands for several sweeps.

    :param title: what it is, in a few words
    :param includes: the sweeps' names
    """

    title: str
    includes: Annotated[list[str], Field(min_length=1)]


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
        return ",".join([self.method, *(f"{axis}={value}" for axis, value in self.settings.items())])

    @property
    def key(self) -> str:
        """What tells the run from all others of its study."""
        return f"{self.configuration},{self.task},seed={self.seed}"


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
        hyperparams = self.methods[method].hyperparams | file.hyperparams
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
    content = _read_yaml(path)
    return _validated(Inclusion, content, path).includes if "includes" in content else [name]


def load_sweep(name: str, overrides: dict[str, Any] | None = None, methods: Sequence[str] | None = None) -> Sweep:
    """
    Read a sweep's file.

    :param name: one of the paper's sweeps, or the path of a file
    :param overrides: fields of the file to replace; hyperparameters are added to the file's
    :param methods: the methods to take, of those that the file names
    :return: the sweep
    :raises SweepError: if the file or an override is wrong: it names the place, the key and what is allowed
    """
    path = find_sweep_file(name)
    content = _read_yaml(path)
    # First the file alone, so that a mistake is said to be where it is
    file = _validated(SweepFile, content, path)
    overrides = {key: value for key, value in (overrides or {}).items() if value is not None}
    changes = [f"{key} {value}" for key, value in overrides.items()]
    if "hyperparams" in overrides:
        overrides = overrides | {"hyperparams": file.hyperparams | overrides["hyperparams"]}
    if overrides:
        file = _validated(SweepFile, content | overrides, "the command line")
    known = file.methods if isinstance(file.methods, dict) else _named_methods(path, file.methods)
    chosen = list(methods or known)
    for method in chosen:
        if method not in known:
            raise SweepError("the command line", "methods", f"{method!r} must be one of {', '.join(known)}")
    if methods:
        changes.append(f"methods {', '.join(chosen)}")
    return Sweep(path.stem, file, {method: known[method] for method in chosen}, changes)


def _named_methods(path: Path, names: list[str]) -> dict[str, Method]:
    beside = path.parent / METHODS_FILE
    source = beside if beside.is_file() else sweeps_folder() / METHODS_FILE
    known = {name: _validated(Method, entry, source, name) for name, entry in _read_yaml(source).items()}
    for name in names:
        if name not in known:
            raise SweepError(path, "methods", f"{name!r} must be one of {', '.join(known)} ({source}), or be defined here")
    return {name: known[name] for name in names}


def _read_yaml(path: Path) -> dict[str, Any]:
    try:
        content = yaml.safe_load(path.read_text())
    except (OSError, yaml.YAMLError) as error:
        raise SweepError(path, "", f"cannot be read: {error}") from error
    if not isinstance(content, dict):
        raise SweepError(path, "", "must be a mapping of keys to values")
    return content


def _validated(kind: type[Any], content: Any, place: object, *keys: str) -> Any:
    """Make a model of data, or say where the data is wrong."""
    try:
        return kind.model_validate(content)
    except ValidationError as error:
        problems = []
        for each in error.errors():
            # The names of alternatives are pydantic's own
            location = [str(part) for part in each["loc"] if not str(part).startswith(("list[", "dict["))]
            given = "" if each["type"] == "missing" or isinstance(each["input"], dict) else f" (it is {each['input']!r})"
            allowed = f", but must be one of {', '.join(kind.model_fields)}" if each["type"] == "extra_forbidden" else ""
            problems.append((".".join([*keys, *location]), each["msg"].removeprefix("Value error, ") + allowed + given))
        raise SweepError(place, problems[0][0], "; ".join(dict.fromkeys(problem for _, problem in problems))) from error
