"""Training as rl_zoo3 does it, with its hyperparameters, which leaves no files."""

import argparse
import tempfile
from typing import Any

import torch as th
from rl_zoo3.exp_manager import ExperimentManager

from benchmark.common.zoo import silence
from sb3_cgp import CGP
from sb3_cgp.zoo.registration import register
from sb3_cgp.zoo.run_folders import release_run


def train_by_zoo(env_id: str, hyperparams: dict[str, Any], seed: int, device: th.device | str = "auto") -> CGP:
    """
    Train as ``rl_zoo3.train --algo cgp`` does, silently and without evaluations.

    :param env_id: the environment
    :param hyperparams: hyperparameters that differ from the YAML file's
    :param seed: the seed
    :param device: device of the networks
    :return: the trained model
    """
    register()
    with tempfile.TemporaryDirectory() as folder, silence():
        manager = ExperimentManager(
            argparse.Namespace(),
            "cgp",
            env_id,
            folder,
            hyperparams=hyperparams,
            eval_freq=-1,
            log_interval=-1,
            verbose=0,
            seed=seed,
            device=str(device),
        )
        model, _ = manager.setup_experiment()  # type: ignore[misc]
        manager.learn(model)
        # rl_zoo3 saves the model then, which releases the folder
        release_run(manager.save_path)
    assert isinstance(model, CGP)
    return model
