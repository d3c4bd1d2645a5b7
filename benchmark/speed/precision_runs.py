"""Runs that train with CEM in float32 or in bfloat16, a record of each."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from benchmark.common.files import file_name, write_json
from benchmark.common.provenance import conditions
from benchmark.common.records import EVALUATION_SEED
from benchmark.common.seeded_runs import check_settings, read_runs
from benchmark.common.zoo import read_entry, shortened_warm_up
from benchmark.speed.elites import critic_overlaps
from benchmark.speed.training import train_by_zoo

DTYPES = ("float32", "bfloat16")
EPISODES = 20


def run(env_id: str, dtype: str, seed: int, args: argparse.Namespace, argv: Sequence[str]) -> dict[str, Any]:
    """
    Train and evaluate once.

    :param env_id: the environment
    :param dtype: ``cem_dtype``
    :param seed: the seed
    :param args: the command line
    :param argv: its arguments, for the record
    :return: the record
    """
    hyperparams = {"cem_dtype": dtype} | ({} if args.steps is None else shortened(env_id, args.steps))
    model = train_by_zoo(env_id, hyperparams, seed, args.device)
    env = make_vec_env(env_id, seed=EVALUATION_SEED)
    returns, _ = evaluate_policy(model, env, EPISODES, return_episode_rewards=True)
    record = {
        **conditions("benchmark.precision", argv, model.device),
        "env": env_id,
        "dtype": dtype,
        "seed": seed,
        "steps": model.num_timesteps,
        "gradient_steps": model._n_updates,
        "returns": returns,
    }
    if dtype == "float32":
        networks = {"critic": model.critic, "target critic": model.critic_target}
        record["overlaps"] = {name: critic_overlaps(model, network) for name, network in networks.items()}
    return record


def shortened(env_id: str, steps: int) -> dict[str, int]:
    """
    Return the hyperparameters of a run of another length than the YAML file's.

    :param env_id: the environment
    :param steps: environment steps
    :return: the length; where more than half of the steps would be random, also ``learning_starts``, for a tenth of them
    """
    entry = read_entry("cgp", env_id)
    mostly_random = 2 * entry.get("learning_starts", 0) > steps
    warm_up = shortened_warm_up("cgp", entry, steps) if mostly_random else {}
    if warm_up:
        print(f"Of the {steps:,} steps, {warm_up['learning_starts']:,} are random, in place of {entry['learning_starts']:,}")
    return {"n_timesteps": steps, **warm_up}


def read_records(folder: Path) -> list[dict[str, Any]]:
    """
    Read the records of finished runs.

    :param folder: the folder of the records
    :return: the records, by task, data type and seed
    :raises ValueError: if one is damaged; it names the file and the remedy
    """
    records = read_runs(folder, ("env", "dtype", "seed", "steps"))
    return sorted(records.values(), key=lambda record: (record["env"], record["dtype"], record["seed"]))


def check_folder(args: argparse.Namespace) -> None:
    """
    Check that the finished runs of a folder are as long as those of the command line, of the environments that it has.

    :param args: the command line
    :raises ValueError: if one has another length, or is damaged
    """
    asked = {env_id: args.steps or int(read_entry("cgp", env_id)["n_timesteps"]) for env_id in args.envs}
    for record in read_records(args.folder):
        if record["env"] in asked:
            check_settings(args.folder, {"steps": record["steps"]}, {"steps": asked[record["env"]]})


def train_missing(args: argparse.Namespace, argv: Sequence[str]) -> None:
    """
    Train the runs that have no record yet.

    :param args: the command line
    :param argv: its arguments, for the records
    """
    for env_id in args.envs:
        for seed in args.seeds:
            for dtype in DTYPES:
                path = args.folder / f"{file_name(env_id)}_{dtype}_seed{seed}.json"
                if not path.exists():
                    write_json(path, run(env_id, dtype, seed, args, argv))
