"""Studies whose truth is known, for the tests of figures, statistics and claims."""

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import torch as th

from benchmark.common.provenance import conditions
from benchmark.common.records import Record, write_records
from benchmark.reporting.scores import Study, read_study

STEPS, INTERVAL = 1_000, 250
GRID = [{"learning_rate": rate, "batch_size": size} for rate in (0.01, 0.001) for size in (64, 32)]
BASELINES = ["CGP-Online", "TD3", "SAC"]
LEVELS = {"CGP-Online": -150.0, "TD3": -300.0, "SAC": -200.0}
SWEEP = "benchmark.sweep"


def record(
    method: str,
    seed: int,
    final: float | None,
    task: str = "Pendulum-v1",
    settings: dict[str, Any] | None = None,
    returns: list[float] | None = None,
    steps: int = STEPS,
) -> Record:
    """A run whose evaluations all were its final one, unless said otherwise."""
    returns = [-1_000.0 if final is None else final] * (steps // INTERVAL) if returns is None else returns
    timesteps = [INTERVAL * (number + 1) for number in range(len(returns))]
    error = "ValueError: NaN" if final is None else None
    return Record("sweep", method, task, settings or {}, seed, steps, timesteps, returns, final, error, 1.0)


def runs(
    score: Callable[[str, dict[str, Any], int], float | None],
    methods: Iterable[str],
    configurations: Iterable[dict[str, Any]] = ({},),
    seeds: Iterable[int] = range(4),
    tasks: Iterable[str] = ("Pendulum-v1",),
) -> list[Record]:
    """All runs of a grid, each scored by its method, its configuration and its seed."""
    return [
        record(method, seed, score(method, settings, seed), task, settings)
        for method in methods
        for task in tasks
        for settings in configurations
        for seed in seeds
    ]


def write_study(folder: Path, records: list[Record], planned: int | None = None) -> Path:
    """Write a study's folder as a sweep exports it."""
    axes: dict[str, list[Any]] = {}
    for run in records:
        for axis, value in run.settings.items():
            axes.setdefault(axis, [])
            axes[axis] += [value] * (value not in axes[axis])
    facts = {
        "title": f"The study {folder.name}",
        "experiment": folder.name,
        "axes": axes,
        "methods": list(dict.fromkeys(run.method for run in records)),
        "tasks": list(dict.fromkeys(run.task for run in records)),
        "seeds": sorted({run.seed for run in records}),
        "steps": max((run.steps for run in records), default=STEPS),
        "evaluation_interval": INTERVAL,
        "evaluation_episodes": 5,
        "settings_in_words": "Hidden width 64.",
        "runs_planned": len(records) if planned is None else planned,
        "commands": [{"runs_ended": 0, **conditions(SWEEP, [folder.name], th.device("cpu"))}],
    }
    write_records(folder, records)
    (folder / "study.json").write_text(json.dumps(facts))
    return folder


def study(folder: Path, records: list[Record], name: str = "sweep", **facts: object) -> Study:
    """Return a study of some records, as the page reads it, with further facts."""
    found = read_study(write_study(folder / name, records))
    found.facts.update(facts)
    return found


def score(method: str, settings: dict[str, Any], seed: int) -> float | None:
    """TD3's third seed fails at a high learning rate; a lower one is better by 10."""
    if (method, settings.get("learning_rate"), seed) == ("TD3", 0.01, 2):
        return None
    return LEVELS.get(method, -500.0) + 10 * (settings.get("learning_rate") == 0.001) + seed
