"""The form of the files in ``hyperparams/sweeps``, and the errors of a file that is not of this form."""

from collections.abc import Sequence
from pathlib import Path
from string import Template
from typing import Annotated, Any

import yaml
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, PositiveInt, ValidationError, model_validator
from pydantic_core import ErrorDetails
from rl_zoo3 import ALGOS

from benchmark.common.environments import (
    check_distinct_names,
    import_packages,
    registered_environment,
    split_env_id,
)
from benchmark.sweeps.random_actions import register_random_actions
from sb3_cgp.zoo.registration import register

Hyperparams = dict[str, Any]
# The types of values that Optuna distinguishes
Value = bool | int | float | str | None


class SweepError(ValueError):
    """
    A sweep's file, or an option that changes it, is wrong.

    :param place: the file, or the option
    :param key: the key in the file, or the name of the option's value
    :param problem: what is wrong, and what is allowed
    """

    def __init__(self, place: object, key: str, problem: str):
        super().__init__(f"{place}: {key}: {problem}" if key else f"{place}: {problem}")


def _known_algorithm(name: str) -> str:
    register()
    register_random_actions()
    if name not in ALGOS:
        raise ValueError(f"must be one of {', '.join(sorted(ALGOS))}")
    return name


def _imported(packages: list[str]) -> list[str]:
    try:
        import_packages(packages)
    except ImportError as error:
        raise ValueError(f"must be modules that can be imported: {error}") from error
    return list(dict.fromkeys(packages))


def _with_distinct_names(tasks: list[str]) -> list[str]:
    check_distinct_names(tasks)
    return tasks


def _with_numbers(hyperparams: Hyperparams) -> Hyperparams:
    starts = hyperparams.get("learning_starts", 0)
    if not isinstance(starts, int | float):
        raise ValueError(f"`learning_starts` must be a number, and not {starts!r}")
    return hyperparams


def _all_different(values: list[Any]) -> list[Any]:
    if len(set(values)) < len(values):
        raise ValueError("must differ from each other")
    return values


class _Strict(BaseModel):
    """Data with no keys but those that are declared."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Packages(_Strict):
    """
    Packages that a command line names.

    :param gym_packages: modules to import, which register environments
    """

    gym_packages: Annotated[list[str], AfterValidator(_imported)]


class Method(_Strict):
    """
    A method to compare.

    :param algo: the algorithm's name in rl_zoo3
    :param hyperparams: all hyperparameters that are not the algorithm's defaults, as in rl_zoo3's YAML files
    :param tuned: start from the entry that the task has in rl_zoo3's (or our) YAML file of the algorithm
    """

    algo: Annotated[str, AfterValidator(_known_algorithm)]
    hyperparams: Annotated[Hyperparams, AfterValidator(_with_numbers)] = {}
    tuned: bool = False


class Axis(_Strict):
    """
    An axis of a sweep: the hyperparameters that are varied, and their values.

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
        elif len(set(map(str, self.values))) < len(self.values):
            raise ValueError("`values` must differ from each other, also when they are written out")
        for template in (self.sets or {}, *self.sets_for.values()):
            _fill(template, None)
        return self

    def hyperparams(self, name: str, value: Any, method: str) -> Hyperparams:
        """
        Return the hyperparameters that a value of the axis stands for.

        :param name: the axis
        :param value: one of its values
        :param method: the method
        :return: hyperparameters
        """
        if isinstance(self.values, dict):
            return self.values[value]
        sets = self.sets_for.get(method, self.sets if self.sets is not None else {name: "$value"})
        return _fill(sets, value)


def _fill(template: Any, value: Any) -> Any:
    """Return a template with the value in place of ``$value``, also within lists and mappings."""
    if template == "$value":
        return value
    if isinstance(template, dict):
        return {key: _fill(each, value) for key, each in template.items()}
    if isinstance(template, list):
        return [_fill(each, value) for each in template]
    if not isinstance(template, str):
        return template
    try:
        return Template(template).substitute(value=value)
    except (KeyError, ValueError) as error:
        raise ValueError(f"`sets` has {template!r}, but only $value stands for something ($$ is a dollar sign)") from error


class SweepFile(_Strict):
    """
    The content of a sweep's file.

    :param title: the sweep's subject, in a few words
    :param gym_packages: modules to import, which register environments, as ``--gym-packages`` of rl_zoo3 does
    :param methods: names from ``methods.yml`` beside the file, or methods of its own by name
    :param tasks: environments; an id of the form ``module:Env-v0`` adds the module to ``gym_packages``
    :param steps: environment steps of each run
    :param seeds: how many seeds, from 0, or a list of seeds
    :param evaluation_interval: environment steps between two evaluations
    :param evaluation_episodes: episodes of each evaluation
    :param checkpoint_interval: environment steps between two states to go on from; by default a tenth of the run,
        from 1,000 to 10,000
    :param hyperparams: hyperparameters for all methods
    :param axes: the axes, by name
    :param exclude: combinations of the axes' values to leave out
    """

    title: str
    methods: Annotated[list[str], Field(min_length=1)] | Annotated[dict[str, Method], Field(min_length=1)]
    # Before the tasks, which are validated in this order
    gym_packages: Annotated[list[str], AfterValidator(_imported)] = []
    tasks: Annotated[
        list[Annotated[str, AfterValidator(registered_environment)]],
        Field(min_length=1),
        AfterValidator(_all_different),
        AfterValidator(_with_distinct_names),
    ]
    steps: PositiveInt
    seeds: (
        PositiveInt
        | Annotated[list[Annotated[int, Field(ge=0, lt=2**32)]], Field(min_length=1), AfterValidator(_all_different)]
    )
    evaluation_interval: PositiveInt
    evaluation_episodes: PositiveInt = 10
    checkpoint_interval: PositiveInt | None = None
    hyperparams: Hyperparams = {}
    axes: dict[str, Axis] = {}
    exclude: list[dict[str, Any]] = []

    @model_validator(mode="before")
    @classmethod
    def _split_tasks(cls, content: Any) -> Any:
        """Move the modules of ids of the form ``module:Env-v0`` to the packages that every worker imports."""
        tasks, packages = content.get("tasks"), content.get("gym_packages", [])
        if not isinstance(tasks, list) or not isinstance(packages, list):
            return content
        names, modules = [], []
        for task in tasks:
            try:
                module, name = split_env_id(task)
            except (AttributeError, ValueError):
                # The task's own validator names the mistake
                module, name = [], task
            names.append(name)
            modules += module
        return {**content, "tasks": names, "gym_packages": [*packages, *modules]}

    @model_validator(mode="after")
    def _check(self) -> "SweepFile":
        if self.evaluation_interval > self.steps:
            raise ValueError(f"`evaluation_interval` is {self.evaluation_interval}, but must be at most `steps`, {self.steps}")
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

    :param title: the subject, in a few words
    :param includes: the sweeps' names
    """

    title: str
    includes: Annotated[list[str], Field(min_length=1)]


def read_yaml(path: Path) -> dict[str, Any]:
    """
    Read a file of keys and values.

    :param path: the file
    :return: its content
    :raises SweepError: if it cannot be read, or holds no mapping
    """
    try:
        content = yaml.safe_load(path.read_text())
    except (OSError, yaml.YAMLError) as error:
        raise SweepError(path, "", f"cannot be read: {error}") from error
    if not isinstance(content, dict):
        raise SweepError(path, "", "must be a mapping of keys to values")
    return content


def validated(kind: type[Any], content: Any, place: object, *keys: str) -> Any:
    """
    Return the validated model of data.

    :param kind: the model's class
    :param content: the data
    :param place: the file or the option that the data comes from
    :param keys: the keys that lead to the data there
    :return: the model
    :raises SweepError: if the data does not fit
    """
    try:
        return kind.model_validate(content)
    except ValidationError as error:
        problems = [(".".join([*keys, *_location(each)]), _problem(each, kind)) for each in _telling(error.errors())]
        raise SweepError(place, problems[0][0], "; ".join(dict.fromkeys(problem for _, problem in problems))) from error


def _telling(errors: Sequence[ErrorDetails]) -> Sequence[ErrorDetails]:
    """Return the errors without those of another alternative, such as that a list is no mapping, where this is possible."""
    telling = [each for each in errors if each["type"] not in ("list_type", "dict_type", "model_type", "int_type")]
    return telling or errors


def _location(error: ErrorDetails) -> list[str]:
    # The names of alternatives are pydantic's own
    return [str(part) for part in error["loc"] if not str(part).startswith(("list[", "dict[", "constrained-"))]


def _problem(error: ErrorDetails, kind: type[BaseModel]) -> str:
    given = "" if error["type"] == "missing" or isinstance(error["input"], dict) else f" (it is {error['input']!r})"
    if error["type"] == "extra_forbidden":
        owners: dict[str, type[BaseModel]] = {"axes": Axis, "methods": Method}
        owner = owners.get(str(error["loc"][0]), kind)
        return f"is not known: it must be one of {', '.join(owner.model_fields)}"
    return error["msg"].removeprefix("Value error, ") + given
