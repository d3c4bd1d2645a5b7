"""What rl_zoo3 reads before it trains, without its output."""

import argparse
import contextlib
import os
from collections.abc import Iterator
from typing import Any

from rl_zoo3.exp_manager import ExperimentManager

from sb3_cgp.zoo.registration import register


def read_entry(algo: str, env_id: str, conf_file: str | None = None) -> dict[str, Any]:
    """
    Read the hyperparameters of a task before any of them is replaced, as ``rl_zoo3.train`` does.

    :param algo: the algorithm's name in rl_zoo3
    :param env_id: a registered environment
    :param conf_file: a YAML file; None for the algorithm's own
    :return: the entry
    :raises ValueError: if the file has neither an entry for the task nor a default
    """
    register()
    manager = ExperimentManager(argparse.Namespace(), algo, env_id, log_folder="", config=conf_file, verbose=0)
    with silence():
        hyperparams, _ = manager.read_hyperparameters()
    return dict(hyperparams)


@contextlib.contextmanager
def silence() -> Iterator[None]:
    """Discard what is printed: rl_zoo3 prints hyperparameters whenever it reads them."""
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
        yield
