"""Ids of environments, also of those that another module registers."""

import difflib
import importlib
from collections.abc import Iterable

import gymnasium as gym


def split_env_id(env_id: str) -> tuple[list[str], str]:
    """
    Split an id of the form ``module:Env-v0`` as Gymnasium does. rl_zoo3 knows such ids by ``--gym-packages module`` and
    ``Env-v0`` only.

    :param env_id: the id
    :return: the module to import, none or one, and the id that it registers
    :raises ValueError: if the id is not of that form
    """
    module, separator, name = env_id.rpartition(":")
    if separator and (not module or ":" in module or not name):
        raise ValueError(f"{env_id!r} must be the id of an environment, or of the form module:id, as in my_package:MyEnv-v0")
    return [module] if separator else [], name


def import_packages(packages: Iterable[str]) -> None:
    """
    Import modules that register environments, as ``--gym-packages`` of rl_zoo3 does.

    :param packages: the modules
    :raises ImportError: if a module cannot be imported
    """
    for package in packages:
        importlib.import_module(package)


def registered_environment(env_id: str) -> str:
    """
    Import the module of an id of the form ``module:Env-v0``, and check that the environment is registered.

    :param env_id: the id
    :return: the id without the module, as it is registered
    :raises ValueError: if the module cannot be imported, or the environment is not registered
    """
    packages, name = split_env_id(env_id)
    try:
        import_packages(packages)
    except ImportError as error:
        raise ValueError(f"the module of {env_id!r} cannot be imported: {error}") from error
    if name not in gym.registry:
        close = difflib.get_close_matches(name, list(gym.registry), n=3)
        remedy = f", such as {', '.join(close)}" if close else ""
        raise ValueError(
            f"must be a registered environment{remedy}; --gym-packages imports a package that registers one, and so does "
            "an id of the form module:Env-v0"
        )
    return name
