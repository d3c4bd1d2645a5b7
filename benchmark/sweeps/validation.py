"""Reading a file into a model of pydantic's, with errors that name the place, the key and the allowed values."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic_core import ErrorDetails


class Strict(BaseModel):
    """Data with no keys but those that are declared."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    # The models of the mappings in the fields, by the field's name
    parts: ClassVar[dict[str, type[BaseModel]]] = {}


class _Loader(yaml.SafeLoader):
    """A loader that refuses a key given twice, of which YAML's others take the last."""

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        node = super().compose_mapping_node(anchor)
        seen = set()
        for key, _ in node.value:
            if (key.tag, str(key.value)) in seen:
                raise yaml.composer.ComposerError(None, None, f"the key {key.value!r} is given twice", key.start_mark)
            seen.add((key.tag, str(key.value)))
        return node


Model = TypeVar("Model", bound=Strict)


class SweepError(ValueError):
    """
    A sweep's file, or an option that changes it, is wrong.

    :param place: the file, or the option
    :param key: the key in the file, or the name of the option's value
    :param problem: what is wrong, and what is allowed
    """

    def __init__(self, place: object, key: str, problem: str):
        super().__init__(f"{place}: {key}: {problem}" if key else f"{place}: {problem}")


def read_yaml(path: Path) -> dict[str, Any]:
    """
    Read a file of keys and values.

    :param path: the file
    :return: its content
    :raises SweepError: if it cannot be read, or holds no mapping
    """
    try:
        content = yaml.load(path.read_text(encoding="utf-8"), Loader=_Loader)
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise SweepError(path, "", f"cannot be read: {error}") from error
    if not isinstance(content, dict):
        raise SweepError(path, "", "must be a mapping of keys to values")
    return content


def validated(kind: type[Model], content: Any, place: object, *keys: str) -> Model:
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
    return [str(part) for part in error["loc"] if not str(part).startswith(("list[", "dict[", "constrained-", "function-"))]


def _problem(error: ErrorDetails, kind: type[Strict]) -> str:
    given = "" if error["type"] == "missing" or isinstance(error["input"], dict) else f" (it is {error['input']!r})"
    if error["type"] == "string_type" and isinstance(error["input"], bool | int | float):
        given = f" (it is {error['input']!r}, as YAML reads it: write it in quotes)"
    if error["type"] == "extra_forbidden":
        owner = kind.parts.get(str(error["loc"][0]), kind)
        return f"is not known: it must be one of {', '.join(owner.model_fields)}"
    return error["msg"].removeprefix("Value error, ") + given
