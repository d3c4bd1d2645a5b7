"""Descriptions of a package whose environments are tested, of an environment, and of a training in it."""

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Learning:
    """
    A short training that shows whether CGP learns.

    :param steps: environment steps
    :param arguments: arguments of CGP's other than the defaults
    :param normalize: whether VecNormalize is around the environment
    """

    steps: int
    arguments: dict[str, Any]
    normalize: bool = False


@dataclass(frozen=True)
class Environment:
    """
    An environment, and the arguments of CGP's that it needs.

    :param id: its name in the table
    :param code: Python that assigns it to ``env``; the page shows it if it has more than the name and a wrapper
    :param policy: the policy's alias
    :param replay_buffer: the name of the replay buffer's class; None for CGP's own
    :param wrappers: what is around the environment, in the table's words
    :param buffer_size: transitions in the check's replay buffer, which are few where they are images
    :param learning: a training that shows whether CGP learns; None if that is not tested
    :param notes: sentences on what to know
    """

    id: str
    code: str
    policy: str = "MlpPolicy"
    replay_buffer: str | None = None
    wrappers: str = ""
    buffer_size: int = 1_000
    learning: Learning | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Package:
    """
    A package of environments, which is installed into a virtual environment of its own.

    :param name: the package's name in commands and in the table
    :param requirements: what pip installs
    :param distributions: those whose versions the table gives, by their normalised names
    :param environments: the environments
    :param notes: sentences on what to know of all of them
    """

    name: str
    requirements: tuple[str, ...]
    distributions: tuple[str, ...]
    environments: tuple[Environment, ...]
    notes: tuple[str, ...] = field(default=())


def made(env_id: str, imported: str = "", arguments: str = "", replayed: bool = False) -> str:
    """
    Return the code that makes an environment by its id.

    :param env_id: the id
    :param imported: the module that registers it; empty for Gymnasium's own
    :param arguments: further arguments of ``make_vec_env``
    :param replayed: whether :func:`~sb3_cgp.resumption.replayed` is around it
    """
    lines = [f"import {imported}"] if imported else []
    lines += ["from stable_baselines3.common.env_util import make_vec_env", ""]
    lines += ["from sb3_cgp.resumption import replayed", ""] if replayed else []
    given = [f'"{env_id}"', *([arguments] if arguments else []), *(["wrapper_class=replayed"] if replayed else [])]
    return "\n".join([*lines, f"env = make_vec_env({', '.join(given)})"])
