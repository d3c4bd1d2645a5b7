"""Small tunings of TD3 and CGP on Pendulum-v1, in the process of a test."""

import optuna
from optuna.samplers import RandomSampler
from rl_zoo3.hyperparams_opt import HYPERPARAMS_SAMPLER

from benchmark import tune
from benchmark.sweeps.tuner import Tuner
from sb3_cgp.zoo.registration import register

register()

TINY = ["learning_starts=30", "batch_size=8", "buffer_size=100", "policy_kwargs=dict(net_arch=[8, 8])", "gradient_steps=1"]
TINY_CGP = [*TINY, "cem_samples=8", "cem_elites=2", "cem_iterations=1", "policy_training=online"]


def arguments(*more, algo="td3", tiny=TINY, trials=2, seeds=2):
    command = ["--algo", algo, "--env", "Pendulum-v1", "--steps", "60", "--seeds", str(seeds), "--trials", str(trials)]
    return [*command, "--eval-episodes", "1", "--device", "cpu", "--set", *tiny, *more]


def tuner_of(args, storage, grace=60.0):
    return Tuner(storage, "study", tune.tuning_of(args), grace)


def samples(algo, task="Pendulum-v1", n_actions=1, her=None):
    """Some trials, with what rl_zoo3's sampler makes of each."""
    study = optuna.create_study(sampler=RandomSampler(seed=0))
    for _ in range(6):
        trial = study.ask()
        more = {"using_her_replay_buffer": her is not None, "her_kwargs": her or {}}
        yield HYPERPARAMS_SAMPLER[algo](trial, n_actions, 1, more), trial.params
