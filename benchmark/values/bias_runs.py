"""Runs that measure the bias of a critic along the training, a record of each."""

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmark.common.files import RETRAIN, file_name, write_json
from benchmark.common.provenance import conditions
from benchmark.common.seeded_runs import check_settings, read_runs
from benchmark.values.bias import BiasCallback
from benchmark.values.methods import METHODS, make_model

# The arguments that all records of a folder share, as they are compared
SETTINGS = ("env", "units", "batch_size", "gamma", "tau", "steps", "learning_starts", "interval", "episodes", "episode_steps")


def run(method: str, seed: int, args: argparse.Namespace, argv: Sequence[str]) -> dict[str, Any]:
    """
    Train once, and measure meanwhile.

    :param method: the method
    :param seed: the seed
    :param args: the command line
    :param argv: its arguments, for the record
    :return: the record
    """
    common = {name: getattr(args, name) for name in ("batch_size", "gamma", "tau", "learning_starts")}
    model = make_model(method, args.env, args.units, seed, args.device, buffer_size=args.steps, **common)
    record = conditions("benchmark.bias", argv, model.device)
    callback = BiasCallback(args.env, args.interval, args.episodes, args.episode_steps)
    started, processor_started = time.perf_counter(), time.process_time()
    model.learn(args.steps, callback)
    return record | {
        "method": method,
        "seed": seed,
        "settings": settings(args),
        "seconds": time.perf_counter() - started,
        "processor_seconds": time.process_time() - processor_started,
        "points": callback.points,
    }


def settings(args: argparse.Namespace) -> dict[str, Any]:
    """
    Return the settings that all records of a folder share.

    :param args: the command line
    :return: values by name
    """
    return {name: getattr(args, name) for name in SETTINGS}


def read_records(folder: Path) -> list[dict[str, Any]]:
    """
    Read the records of finished runs.

    :param folder: the folder of the records
    :return: the records, by method, in the order of ``METHODS``, and seed
    :raises ValueError: if one is damaged, or of an unknown method; it names the file and the remedy
    """
    records = read_runs(folder, ("method", "seed", "settings", "points"))
    for path, record in records.items():
        if record["method"] not in METHODS:
            raise ValueError(
                f"{path} has the method {record['method']!r}, which must be one of {', '.join(METHODS)}. {RETRAIN}"
            )
    return sorted(records.values(), key=lambda record: (list(METHODS).index(record["method"]), record["seed"]))


def check_folder(args: argparse.Namespace) -> None:
    """
    Check that the finished runs of a folder have the settings of the command line.

    :param args: the command line
    :raises ValueError: if one has other settings, or is damaged
    """
    asked = settings(args)
    for record in read_records(args.folder):
        check_settings(args.folder, record["settings"], asked)


def train_missing(args: argparse.Namespace, argv: Sequence[str]) -> None:
    """
    Train the runs that have no record yet, all methods with the first seed first.

    :param args: the command line
    :param argv: its arguments, for the records
    """
    for seed in args.seeds:
        for method in args.methods:
            path = args.folder / f"{file_name(args.env)}_{method}_seed{seed}.json"
            if not path.exists():
                write_json(path, run(method, seed, args, argv))
