"""Entries of rl_zoo3's YAML files: the entry of a task, the entry of a sampled configuration, and writing an entry."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import yaml
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER

from benchmark.common.zoo import read_entry
from benchmark.sweeps.sweep_files import Hyperparams
from sb3_cgp.common.files import write_atomically
from sb3_cgp.zoo.folders import ALGO
from sb3_cgp.zoo.search_space import convert_cgp_params

# The parameters that only rl_zoo3's sampler for hindsight replay suggests
HER_KWARGS = ("n_sampled_goal", "goal_selection_strategy")


def base_entry(algo: str, task: str, conf_file: str | None = None) -> Hyperparams:
    """
    Read the hyperparameters of a task before any of them is sampled, as ``rl_zoo3.train`` does.

    :param algo: the algorithm's name in rl_zoo3
    :param task: the environment
    :param conf_file: a YAML file; by default the algorithm's own
    :return: the entry
    :raises ValueError: if the file has none for the task, and no default, or one that no YAML file can hold
    """
    try:
        return yaml.safe_load(yaml.safe_dump(read_entry(algo, task, conf_file)))
    except yaml.YAMLError as error:
        raise ValueError(f"The hyperparameters of {algo} for {task} are no plain data: {error}") from error


def sampled_entry(
    algo: str, base: Hyperparams, params: Mapping[str, Any], fixed: Mapping[str, Any] | None = None
) -> Hyperparams:
    """
    Return the entry of a YAML file with the parameters of a trial.

    rl_zoo3's samplers return objects that no YAML file can hold. Its converters make hyperparameters of the same parameters,
    but not always such that a YAML file may have them.

    :param algo: the algorithm's name in rl_zoo3
    :param base: the task's entry
    :param params: the trial's parameters
    :param fixed: hyperparameters that replace sampled ones, and that other sampled ones follow
    :return: the entry
    """
    fixed = fixed or {}
    convert = partial(convert_cgp_params, fixed=fixed) if algo == ALGO else HYPERPARAMS_CONVERTER[algo]
    sampled = convert(dict(params))
    if "policy_kwargs" in sampled:
        sampled["policy_kwargs"] = _in_python(sampled["policy_kwargs"])
    her_kwargs = {name: sampled.pop(name) for name in HER_KWARGS if name in sampled} | sampled.pop("replay_buffer_kwargs", {})
    if her_kwargs:
        sampled["replay_buffer_kwargs"] = _in_python(_evaluated(base.get("replay_buffer_kwargs", {})) | her_kwargs)
    entry = {**base, **sampled, **fixed}
    # rl_zoo3's converters use None for no noise, which is no argument of the algorithms; then the std goes, too
    if entry.get("noise_type") is None:
        entry.pop("noise_type", None)
        entry.pop("noise_std", None)
    return entry


def _in_python(arguments: Mapping[str, Any]) -> str:
    """Write a dictionary as rl_zoo3's YAML files do, to be evaluated where ``nn`` is known."""
    values = {name: f"nn.{value.__name__}" if isinstance(value, type) else repr(value) for name, value in arguments.items()}
    return f"dict({', '.join(f'{name}={value}' for name, value in values.items())})"


def _evaluated(arguments: str | dict[str, Any]) -> dict[str, Any]:
    # As rl_zoo3 evaluates the same text
    return eval(arguments) if isinstance(arguments, str) else arguments


def write_entry(path: Path, task: str, entry: Hyperparams, comment: str) -> None:
    """
    Write a task's entry into a YAML file, in place of its present entry; nothing else of the file changes.

    :param path: the file, which is created if it is missing
    :param task: the environment
    :param entry: the hyperparameters
    :param comment: a line on the origin of the hyperparameters
    :raises ValueError: if the file is not one of entries by task, or another entry refers to the one to be replaced
    """
    # A symbolic link stays one
    path = path.resolve()
    write_atomically(path, _changed(path, task, entry, comment).encode())


def check_file(path: Path, task: str) -> None:
    """
    Check that :func:`write_entry` could write an entry.

    :param path: the file, which may be missing
    :param task: the environment
    :raises ValueError: if it could not
    """
    _changed(path.resolve(), task, {"policy": "any"}, "any")


def _changed(path: Path, task: str, entry: Hyperparams, comment: str) -> str:
    """Return a file's text with a task's entry in place of the present one, or after all others."""
    text, before, (start, end) = _read(path, task)
    # Lines end as before
    ending = "\r\n" if "\r\n" in text else "\n"
    body = yaml.safe_dump(entry, sort_keys=True, allow_unicode=True)
    block = [f"{task}:", f"  # {comment}", *(f"  {line}" for line in body.splitlines())]
    lines = text.splitlines()
    after = ending.join([*lines[:start], *block, *lines[end:]]) + ending
    if _loaded(after) != {**before, task: entry}:
        raise ValueError(
            f"{path} is not changed: its entry {task} cannot be written without a change of others'. Entries must begin on "
            "lines of their own, each task's once, without an anchor that others refer to, and without a final `...`"
        )
    return after


def _read(path: Path, task: str) -> tuple[str, dict[str, Any], tuple[int, int]]:
    """Return a file's text, its entries, and the lines of a task's entry, as :func:`_lines_of` does."""
    if path.is_dir():
        raise ValueError(f"{path} is a folder, and must be a YAML file")
    try:
        text = path.read_bytes().decode() if path.is_file() else ""
        entries = yaml.safe_load(text) or {}
        lines = _lines_of(task, text)
    except (UnicodeDecodeError, yaml.YAMLError) as error:
        raise ValueError(f"{path} is no YAML file: {error}") from error
    if not isinstance(entries, dict):
        raise ValueError(f"{path} is not changed: it must be a mapping of tasks to their entries")
    return text, entries, lines


def _loaded(text: str) -> Any:
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError:
        return None


def _lines_of(task: str, text: str) -> tuple[int, int]:
    """Return the first line of a task's entry and the line after its last; twice the number of lines if it has none."""
    lines = text.splitlines()
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    for key, value in root.value if isinstance(root, yaml.MappingNode) else ():
        if key.value == task:
            start, end = key.start_mark.line, value.end_mark.line + (value.end_mark.column > 0)
            # Comments before the next entry belong to that entry
            while end > start + 1 and (not lines[end - 1].strip() or lines[end - 1].startswith("#")):
                end -= 1
            return start, end
    return len(lines), len(lines)
