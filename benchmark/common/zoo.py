"""What rl_zoo3 reads before it trains, without its output."""

import argparse
import contextlib
import inspect
import json
import os
from collections.abc import Iterator, Mapping
from typing import Any

import yaml
from rl_zoo3 import ALGOS
from rl_zoo3.exp_manager import ExperimentManager

from sb3_cgp.zoo.registration import register

# Points of a learning curve
EVALUATIONS_PER_RUN = 20


def read_entry(algo: str, env_id: str, conf_file: str | None = None) -> dict[str, Any]:
    """
    Read the hyperparameters of a task before any of them is replaced, as ``rl_zoo3.train`` does.

    :param algo: the algorithm's name in rl_zoo3
    :param env_id: a registered environment
    :param conf_file: a YAML file; None for the algorithm's own
    :return: the entry
    :raises ValueError: if the file cannot be read, or has neither an entry for the task nor a default
    """
    register()
    manager = ExperimentManager(argparse.Namespace(), algo, env_id, log_folder="", config=conf_file, verbose=0)
    try:
        with silence():
            hyperparams, _ = manager.read_hyperparameters()
    except OSError as error:
        raise ValueError(f"The file of hyperparameters {conf_file} cannot be read: {error.strerror}") from error
    except (yaml.YAMLError, AttributeError, TypeError) as error:
        if conf_file is None:
            raise
        problem = "is no mapping of tasks to hyperparameters"
        raise ValueError(f"The file of hyperparameters {conf_file} {problem}: {error}") from error
    return dict(hyperparams)


def random_steps(algo: str, hyperparams: Mapping[str, Any]) -> int:
    """
    Return the number of random steps at the start of a run.

    :param algo: the algorithm's name in rl_zoo3
    :param hyperparams: the run's hyperparameters
    :return: ``learning_starts``, or its default; 0 for an algorithm that has none, or that is not known
    """
    register()
    parameters = inspect.signature(ALGOS[algo]).parameters if algo in ALGOS else {}
    default = parameters["learning_starts"].default if "learning_starts" in parameters else 0
    return int(hyperparams.get("learning_starts", default))


def without_defaults(entry: Mapping[str, Any]) -> str:
    """
    Return a text that is the same for hyperparameters of a run that differ only by their algorithm's defaults.

    :param entry: the hyperparameters, and "algo", the algorithm's name in rl_zoo3
    :return: those that are no defaults, as JSON; all, for an algorithm that is not known
    """
    register()
    algorithm = ALGOS.get(entry.get("algo", ""))
    parameters = {} if algorithm is None else inspect.signature(algorithm).parameters
    defaults = {name: _each_step(parameter.default) for name, parameter in parameters.items()}
    own = {name: value for name, value in entry.items() if name not in defaults or _each_step(value) != defaults[name]}
    return json.dumps(own, sort_keys=True, default=str)


def _each_step(value: Any) -> Any:
    """Return a frequency in steps as a number, as SB3 takes both."""
    return value[0] if isinstance(value, list | tuple) and list(value[1:]) == ["step"] else value


def shortened_warm_up(algo: str, hyperparams: Mapping[str, Any], steps: int) -> dict[str, int]:
    """
    Return the hyperparameter by which at most a tenth of a shortened run's steps are random.

    :param algo: the algorithm's name in rl_zoo3
    :param hyperparams: the run's hyperparameters
    :param steps: environment steps of the run
    :return: ``learning_starts``; nothing where no more steps are random than that
    """
    most = steps // 10
    return {"learning_starts": most} if random_steps(algo, hyperparams) > most else {}


def warm_up_in_words(steps: int, learning_starts: int, remedy: str) -> str:
    """
    Return the line that tells the user of a shortened warm-up.

    :param steps: environment steps of each run
    :param learning_starts: those of them that are random
    :param remedy: the option that sets another number
    :return: the line
    """
    return (
        f"Of the {steps:,} steps, {learning_starts:,} are random (learning_starts={learning_starts}), as at most a tenth of a "
        f"shortened run is; {remedy} sets another number"
    )


@contextlib.contextmanager
def silence() -> Iterator[None]:
    """Discard what is printed: rl_zoo3 prints hyperparameters whenever it reads them."""
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
        yield
