"""The name of CGP in rl_zoo3, and the folders of its hyperparameters and of a run's training states."""

import os
from pathlib import Path

ALGO = "cgp"


def hyperparams_folder() -> Path:
    """
    Return the folder of the hyperparameters in rl_zoo3's format.

    :return: the folder within the package where that was installed from a wheel, and beside the package in a source tree or
        an editable install
    :raises FileNotFoundError: if neither folder holds ``cgp.yml``
    """
    package = Path(__file__).resolve().parent.parent
    for folder in (package / "hyperparams", package.parent / "hyperparams"):
        if (folder / f"{ALGO}.yml").is_file():
            return folder
    raise FileNotFoundError(f"hyperparams/{ALGO}.yml is neither in {package} nor beside it: please install sb3_cgp again")


def state_folder(save_path: str) -> str:
    """
    Return the folder of a run's training states.

    :param save_path: the run's folder
    :return: the folder of the states
    """
    return os.path.join(save_path, "state")
