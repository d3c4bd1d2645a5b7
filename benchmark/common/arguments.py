"""Types of arguments: each reads a text of the command line, and refuses it by name if it is wrong."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch as th
import yaml
from gymnasium import spaces
from stable_baselines3.common.utils import get_device

from benchmark.common.environments import split_env_id


def count(text: str) -> int:
    """
    Read a count.

    :param text: the argument
    :return: the number, at least 1
    :raises argparse.ArgumentTypeError: if it is no integer of at least 1
    """
    return _integer(text, lambda number: number >= 1, ">= 1")


def natural(text: str) -> int:
    """
    Read a natural number.

    :param text: the argument
    :return: the number, at least 0
    :raises argparse.ArgumentTypeError: if it is no integer of at least 0
    """
    return _integer(text, lambda number: True, ">= 0")


def seed(text: str) -> int:
    """
    Read a seed that NumPy takes.

    :param text: the argument
    :return: the seed
    :raises argparse.ArgumentTypeError: if it is no integer within [0, 2**32)
    """
    return _integer(text, lambda number: number < 2**32, "within [0, 2**32)")


def _integer(text: str, is_allowed: Callable[[int], bool], allowed: str) -> int:
    """Read an integer of at least 0 that fulfils a condition."""
    if not text.isdecimal() or not is_allowed(int(text)):
        raise argparse.ArgumentTypeError(f"{text!r} is not an integer {allowed}")
    return int(text)


def device(text: str) -> th.device:
    """
    Read the name of a device, and check that it is available.

    :param text: the argument; "auto" for the GPU, if one is available
    :return: the device
    :raises argparse.ArgumentTypeError: if no such device is available
    """
    try:
        found = get_device(text)
        th.empty(0, device=found)
    except (RuntimeError, AssertionError) as error:
        raise argparse.ArgumentTypeError(f"{text!r} is not available: {str(error).splitlines()[0]}") from error
    # SB3 silently takes the CPU in place of a missing GPU
    if found.type != text.partition(":")[0] and text != "auto":
        raise argparse.ArgumentTypeError(f"{text!r} is not available")
    return found


def device_name(text: str) -> str:
    """
    Check the name of a device, for processes that this one starts; "auto" is resolved by them.

    :param text: the argument
    :return: the text
    :raises argparse.ArgumentTypeError: if no such device is available
    """
    if text != "auto":
        device(text)
    return text


def continuous_environment(text: str) -> str:
    """
    Read the id of an environment, and check that it can be made and has continuous actions.

    :param text: the argument; ``module:Env-v0`` imports the module that registers the environment
    :return: the id, as it is registered
    :raises argparse.ArgumentTypeError: if the environment cannot be made, or has other actions
    """
    try:
        env = gym.make(text)
    except (gym.error.Error, ImportError) as error:
        raise argparse.ArgumentTypeError(f"{text!r} cannot be made: {error}") from error
    env.close()
    if not isinstance(env.action_space, spaces.Box):
        raise argparse.ArgumentTypeError(f"{text!r} has no continuous actions, but {env.action_space}")
    return split_env_id(text)[1]


def hyperparameter(text: str) -> tuple[str, Any]:
    """
    Read a hyperparameter, as in ``learning_starts=500``.

    :param text: the argument
    :return: its name and value
    :raises argparse.ArgumentTypeError: if it is not of this form, or its value is no YAML
    """
    name, separator, value = text.partition("=")
    if not separator or not name.isidentifier():
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form name=value")
    try:
        read = yaml.safe_load(value)
    except yaml.YAMLError as error:
        raise argparse.ArgumentTypeError(f"{text!r} has a value that is no YAML: {error}") from error
    try:
        # YAML reads 1e-3 as a string
        return name, float(read) if isinstance(read, str) else read
    except ValueError:
        return name, read


def add_hyperparameters(parser: argparse.ArgumentParser, text: str) -> None:
    """
    Add the argument that sets hyperparameters, which may be given several times.

    :param parser: the command's parser
    :param text: the argument's help
    """
    parser.add_argument("--set", nargs="+", action="extend", type=hyperparameter, default=[], metavar="NAME=VALUE", help=text)


def output_folder(text: str) -> Path:
    """
    Read the path of a folder, and create it at once, so that no measurement ends without a folder for its results.

    :param text: the argument
    :return: the folder
    :raises argparse.ArgumentTypeError: if it cannot be created
    """
    folder = Path(text)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise argparse.ArgumentTypeError(f"{text!r} cannot be made: {error.strerror}") from error
    return folder


def add_epilog(parser: argparse.ArgumentParser, *paragraphs: str) -> None:
    """
    Let a command's help end with examples, its duration and the place of its results, with their line breaks.

    :param parser: the command's parser
    :param paragraphs: the paragraphs
    """
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    # argparse formats the text of an epilog, and only %(prog)s is defined in it
    parser.epilog = "\n\n".join(paragraphs).replace("%", "%%")
