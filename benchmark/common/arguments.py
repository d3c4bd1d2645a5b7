"""The arguments that the measuring commands share, refused by name where they are wrong."""

import argparse
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch as th
import yaml
from gymnasium import spaces
from stable_baselines3.common.utils import get_device


def count(text: str) -> int:
    """
    Read a number of things.

    :param text: the argument
    :return: the number, at least 1
    :raises argparse.ArgumentTypeError: if it is not such a number
    """
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not an integer >= 1")
    return int(text)


def device(text: str) -> th.device:
    """
    Read the name of a device, and see whether it is there.

    :param text: the argument; "auto" for the GPU if there is one
    :return: the device
    :raises argparse.ArgumentTypeError: if there is none of that name
    """
    try:
        found = get_device(text)
        th.empty(0, device=found)
    except (RuntimeError, AssertionError) as error:
        raise argparse.ArgumentTypeError(f"{text!r} is not available: {str(error).splitlines()[0]}") from error
    # SB3 quietly takes the CPU in place of a GPU that is missing
    if found.type != text.partition(":")[0] and text != "auto":
        raise argparse.ArgumentTypeError(f"{text!r} is not available")
    return found


def continuous_environment(text: str) -> str:
    """
    Read the name of an environment, and see whether it can be made and has continuous actions.

    :param text: the argument
    :return: the name
    :raises argparse.ArgumentTypeError: if it cannot be used
    """
    try:
        env = gym.make(text)
    except (gym.error.Error, ImportError) as error:
        raise argparse.ArgumentTypeError(f"{text!r} cannot be made: {error}") from error
    env.close()
    if not isinstance(env.action_space, spaces.Box):
        raise argparse.ArgumentTypeError(f"{text!r} has no continuous actions, but {env.action_space}")
    return text


def hyperparameter(text: str) -> tuple[str, Any]:
    """
    Read a hyperparameter, as in ``learning_starts=500``.

    :param text: the argument
    :return: its name and value
    :raises argparse.ArgumentTypeError: if it is not of that form
    """
    name, separator, value = text.partition("=")
    if not separator or not name.isidentifier():
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form name=value")
    try:
        read = yaml.safe_load(value)
    except yaml.YAMLError as error:
        raise argparse.ArgumentTypeError(f"{text!r} has a value that is no YAML: {error}") from error
    try:
        # YAML takes 1e-3 for a string
        return name, float(read) if isinstance(read, str) else read
    except ValueError:
        return name, read


def output_folder(text: str) -> Path:
    """
    Read the name of a folder, and make it now: a long measurement shall not end without a place for its results.

    :param text: the argument
    :return: the folder
    :raises argparse.ArgumentTypeError: if it cannot be made
    """
    folder = Path(text)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise argparse.ArgumentTypeError(f"{text!r} cannot be made: {error.strerror}") from error
    return folder
