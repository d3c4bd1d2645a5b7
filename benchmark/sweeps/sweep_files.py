"""The form of the files in ``hyperparams/sweeps``, and the errors of a file that is not of this form."""

from string import Template
from typing import Annotated, Any, ClassVar

from huggingface_sb3 import EnvironmentName
from pydantic import AfterValidator, BaseModel, BeforeValidator, Field, PositiveInt, model_validator
from rl_zoo3 import ALGOS

from benchmark.common.environments import (
    import_packages,
    registered_environment,
    split_env_id,
)
from benchmark.sweeps.random_actions import register_random_actions
from benchmark.sweeps.validation import Strict
from sb3_cgp.zoo.registration import register

Hyperparams = dict[str, Any]
# The types of values that Optuna distinguishes
Value = bool | int | float | str | None

# The parameters and attributes of a run, which its axes must not replace
RESERVED = ("method", "task", "seed")


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
    ids: dict[str, str] = {}
    for env_id in tasks:
        # The name in rl_zoo3's folders
        name = str(EnvironmentName(env_id))
        if name in ids:
            raise ValueError(
                f"{ids[name]!r} and {env_id!r} have the same name in rl_zoo3's folders, {name}: run them as two sweeps, with "
                "a --study for each"
            )
        ids[name] = env_id
    return tasks


def _with_numbers(hyperparams: Hyperparams) -> Hyperparams:
    starts = hyperparams.get("learning_starts", 0)
    if not isinstance(starts, int | float):
        raise ValueError(f"`learning_starts` must be a number, and not {starts!r}")
    return hyperparams


def _number_or_list(seeds: Any) -> Any:
    # Pydantic reads 0-3 as -3
    if isinstance(seeds, str) and not seeds.isdecimal():
        raise ValueError("must be a number of seeds, or a list of seeds, such as [0, 1, 2, 3]")
    return seeds


def _all_different(values: list[Any]) -> list[Any]:
    if len(set(values)) < len(values):
        raise ValueError("must differ from each other")
    return values


class Packages(Strict):
    """
    Packages that a command line names.

    :param gym_packages: modules to import, which register environments
    """

    gym_packages: Annotated[list[str], AfterValidator(_imported)]


class Method(Strict):
    """
    A method to compare.

    :param algo: the algorithm's name in rl_zoo3
    :param hyperparams: all hyperparameters that are not the algorithm's defaults, as in rl_zoo3's YAML files
    :param tuned: start from the entry that the task has in rl_zoo3's (or our) YAML file of the algorithm
    """

    algo: Annotated[str, AfterValidator(_known_algorithm)]
    hyperparams: Annotated[Hyperparams, AfterValidator(_with_numbers)] = Field(default_factory=dict)
    tuned: bool = False


class Axis(Strict):
    """
    An axis of a sweep: the hyperparameters that are varied, and their values.

    :param values: a list of values, or names of values with the hyperparameters that each stands for
    :param sets: the hyperparameters that are set, where ``$value`` stands for the value; for a list of values, by
        default the hyperparameter of the axis's own name
    :param sets_for: the same for single methods, in place of ``sets``
    """

    values: Annotated[list[Value], Field(min_length=1)] | Annotated[dict[str, Hyperparams], Field(min_length=1)]
    sets: Hyperparams | None = None
    sets_for: dict[str, Hyperparams] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _check(self) -> "Axis":
        if isinstance(self.values, dict):
            if self.sets is not None or self.sets_for:
                raise ValueError("`sets` and `sets_for` are for a list of values: named values set their own hyperparameters")
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


class SweepFile(Strict):
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

    parts: ClassVar[dict[str, type[BaseModel]]] = {"axes": Axis, "methods": Method}

    title: str
    methods: Annotated[list[str], Field(min_length=1)] | Annotated[dict[str, Method], Field(min_length=1)]
    # Before the tasks, which are validated in this order
    gym_packages: Annotated[list[str], AfterValidator(_imported)] = Field(default_factory=list)
    tasks: Annotated[
        list[Annotated[str, AfterValidator(registered_environment)]],
        Field(min_length=1),
        AfterValidator(_all_different),
        AfterValidator(_with_distinct_names),
    ]
    steps: PositiveInt
    seeds: Annotated[
        PositiveInt
        | Annotated[list[Annotated[int, Field(ge=0, lt=2**32)]], Field(min_length=1), AfterValidator(_all_different)],
        BeforeValidator(_number_or_list),
    ]
    evaluation_interval: PositiveInt
    evaluation_episodes: PositiveInt = 10
    checkpoint_interval: PositiveInt | None = None
    hyperparams: Hyperparams = Field(default_factory=dict)
    axes: dict[str, Axis] = Field(default_factory=dict)
    exclude: list[dict[str, Any]] = Field(default_factory=list)

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
        values = [value for axis in self.axes.values() for value in axis.values if isinstance(value, str)]
        for name in (self.title, *self.methods, *self.axes, *values):
            if not name.isprintable():
                raise ValueError(f"{name!r} must be a name of one line, without tabs, as it stands in headings and tables")
        for name, axis in self.axes.items():
            if name in RESERVED:
                raise ValueError(
                    f"`axes` names {name!r}, but {', '.join(RESERVED)} are names of a run's own: choose another name"
                )
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


class Inclusion(Strict):
    """
    A file that stands for several sweeps.

    :param title: the subject, in a few words
    :param includes: the sweeps' names
    """

    title: str
    includes: Annotated[list[str], Field(min_length=1)]
