"""Small sweeps whose runs are trained as populations."""

from functools import partial

import torch as th
import yaml
from optuna.storages import InMemoryStorage

from benchmark.sweeps import population_run
from benchmark.sweeps.experiments import load_sweep
from benchmark.sweeps.studies import Ledger
from benchmark.sweeps.worker_loop import execute_runs
from sb3_cgp.population import ChunkedSubprocVecEnv

TINY = dict(policy="MlpPolicy", learning_starts=20, batch_size=8, buffer_size=400, policy_kwargs="dict(net_arch=[8, 8])")

NOISE = dict(noise_type="normal", noise_std=0.1)


def write_sweep(folder, methods, seeds=2, steps=120, **changes):
    """A sweep of methods, each an algorithm and hyperparameters."""
    content = dict(
        title="A sweep",
        methods={name: {"algo": algo, "hyperparams": TINY | hyperparams} for name, (algo, hyperparams) in methods.items()},
        tasks=["Pendulum-v1"],
        steps=steps,
        seeds=seeds,
        evaluation_interval=40,
        evaluation_episodes=1,
        checkpoint_interval=30,
    )
    path = folder / "tiny.yml"
    path.write_text(yaml.safe_dump(content | changes))
    return path


def rows(folder):
    """The episodes of a monitor, without times."""
    return [line.split(",")[:2] for line in (folder / "0.monitor.csv").read_text().splitlines()[1:]]


def study_of(path, population, logs):
    """Train a sweep in this process, and return its study."""
    sweep = load_sweep(str(path))
    ledger = Ledger(InMemoryStorage(), "tiny")
    ledger.open(sweep, {"experiment": sweep.name})
    execute_runs(ledger, logs, "a process", device="cpu", population=population)
    return ledger


def in_processes(monkeypatch):
    """Step environments in other processes, as on a GPU. SB3's default method of starting them takes long."""
    monkeypatch.setattr(population_run, "get_device", lambda device: th.device("cuda"))
    fork = partial(ChunkedSubprocVecEnv, n_processes=2, start_method="fork")
    monkeypatch.setattr(population_run, "ChunkedSubprocVecEnv", fork)
