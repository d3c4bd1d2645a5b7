"""The rules on the keyword arguments of an algorithm's ``load``, of which SB3 accepts any name."""

import inspect
import io
import json
import pathlib
import zipfile
from collections.abc import Iterable, Mapping
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import open_path

from sb3_cgp.common.rules import nearest, unknown_argument
from sb3_cgp.common.sb3_arguments import constructor_argument_names

# The parameters of SB3's `load` that may be given by keyword
PARAMETERS = frozenset(inspect.signature(BaseAlgorithm.load).parameters) - {"path", "kwargs"}

SavedModel = str | pathlib.Path | io.BufferedIOBase


def check_load_arguments(
    algorithm: type[BaseAlgorithm], saved: SavedModel, arguments: Mapping[str, Any], method: str = "load"
) -> None:
    """
    Refuse keyword arguments of ``load`` that would have no effect.

    SB3 sets each of them as an attribute of the model. A misspelt one changes nothing.

    :param algorithm: the algorithm's class
    :param saved: the path of the saved model, or an open file; an open file's position is restored
    :param arguments: the keyword arguments
    :param method: the method that the user has called
    :raises TypeError: if an argument is neither a parameter of SB3's ``load``, nor an argument of the algorithm's constructor,
        nor an attribute of a model. The error names the argument, its value and the nearest name that is allowed.
    """
    own = constructor_argument_names(algorithm) - {"self"}
    # `resume` gives this one itself
    parameters = PARAMETERS - {"force_reset"} if method == "resume" else PARAMETERS
    unknown = [name for name in arguments if name not in own | parameters]
    if not unknown:
        return
    saved_names = saved_attributes(saved).keys()
    if not saved_names:
        return
    attributes = saved_names | _attributes(algorithm)
    for name in (name for name in unknown if name not in attributes):
        public = {each for each in attributes if not each.startswith("_")}
        usage = (
            f"It takes {', '.join(sorted(parameters))}, the constructor's arguments {', '.join(sorted(own))}, and the "
            "names of attributes of the model."
        )
        called = f"{algorithm.__name__}.{method}"
        raise unknown_argument(called, name, arguments[name], parameters | own | public, usage=usage)


def misspelt_custom_objects(saved: SavedModel, names: Iterable[str]) -> dict[str, str]:
    """
    Return the custom objects whose names the saved model lacks and that are almost equal to names that it has.

    A name without a similar one is left out, as rl_zoo3 gives the same custom objects to all algorithms.

    :param saved: the path of the saved model, or an open file
    :param names: the names of the custom objects
    :return: the nearest name of an attribute, by the custom object's name
    """
    attributes = saved_attributes(saved)
    found = {name: nearest(name, attributes, cutoff=0.85) for name in names if name not in attributes}
    return {name: similar for name, similar in found.items() if similar is not None} if attributes else {}


def saved_attributes(saved: SavedModel) -> dict[str, Any]:
    """
    Return the attributes that a saved model holds, by name, without unpickling it.

    :param saved: the path of the saved model, or an open file, whose position is restored
    :return: the attributes, as JSON has them: those that are pickled, as the pickle; none for a file that ``load`` refuses,
        with an error of its own
    """
    try:
        if isinstance(saved, io.BufferedIOBase):
            position = saved.tell()
            try:
                return _attributes_in(saved)
            finally:
                saved.seek(position)
        with open_path(saved, "r", suffix="zip") as file:
            return _attributes_in(file)
    except (OSError, ValueError, KeyError, zipfile.BadZipFile):
        return {}


def _attributes_in(file: Any) -> dict[str, Any]:
    with zipfile.ZipFile(file) as archive:
        return dict(json.loads(archive.read("data")))


def _attributes(algorithm: type[BaseAlgorithm]) -> set[str]:
    """Return the names of the attributes of a model whose networks are not built, and of those that the class declares."""
    policy = next(iter(algorithm.policy_aliases.values()))
    # As SB3's `load` constructs it
    model = algorithm(policy=policy, env=None, _init_setup_model=False)  # type: ignore[call-arg]
    declared = {name for each in algorithm.__mro__ for name in (*vars(each).get("__annotations__", {}), *vars(each))}
    # A property of the class hides an attribute of the same name
    hidden = {name for name in declared if callable(value := getattr(algorithm, name, None)) or isinstance(value, property)}
    return {name for name in (*vars(model), *declared) if not name.startswith("__")} - hidden
