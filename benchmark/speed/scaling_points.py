"""The cost of training by CEM's settings, the networks, the spaces and the number of parallel environments."""

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch as th
from stable_baselines3 import TD3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from benchmark.speed.boxes import BoxEnv
from benchmark.speed.timing import interleaved, summary
from sb3_cgp import CGP

BATCH_SIZE = 128
# Random steps before the first gradient step
WARM_UP = 256
NO_LOG = 10**9
AXES: dict[str, tuple[int, ...]] = {
    "cem_iterations": (1, 2, 4, 8),
    "cem_samples": (16, 32, 64, 128, 256),
    "width": (64, 128, 256, 512),
    "action_dim": (1, 6, 17, 64),
    "observation_dim": (17, 64, 256, 1024),
    "n_envs": (1, 2, 4, 8, 16),
}


@dataclass(frozen=True)
class Setting:
    """
    The settings of one measurement, by default the paper's at HalfCheetah's sizes.

    :param algorithm: "CGP" or "TD3"
    :param cem_iterations: iterations of CEM
    :param cem_samples: CEM's samples per state and iteration
    :param width: units of each of the two hidden layers
    :param action_dim: action dimensions
    :param observation_dim: observation dimensions
    :param n_envs: parallel environments; None for one :class:`~benchmark.speed.boxes.BoxEnv` in place of a real one
    """

    algorithm: str
    cem_iterations: int = 2
    cem_samples: int = 64
    width: int = 256
    action_dim: int = 6
    observation_dim: int = 17
    n_envs: int | None = None


def setting_at(algorithm: str, axis: str, value: int) -> Setting:
    """
    Return the setting at a point of an axis.

    :param algorithm: "CGP" or "TD3"
    :param axis: the varied field of the setting
    :param value: its value
    :return: the setting; TD3 has no CEM to vary, and is the same all along its axes
    """
    if algorithm == "TD3" and axis.startswith("cem_"):
        return Setting(algorithm)
    varied: dict[str, Any] = {axis: value}
    return replace(Setting(algorithm), **varied)


def make_env(setting: Setting, env_id: str, seed: int) -> VecEnv:
    """
    Return the environments of a setting.

    :param setting: the setting
    :param env_id: the environment, where the number of environments is measured
    :param seed: their seed
    :return: the environments
    """
    if setting.n_envs is not None:
        return make_vec_env(env_id, setting.n_envs, seed=seed)
    return make_vec_env(partial(BoxEnv, setting.observation_dim, setting.action_dim), seed=seed)


def make_model(setting: Setting, env: VecEnv, seed: int, device: th.device) -> OffPolicyAlgorithm:
    """
    Return the model of a setting, with enough transitions in its buffer for training.

    :param setting: the setting
    :param env: its environments
    :param seed: seed of its random numbers
    :param device: device of its networks
    :return: the model
    """
    common: dict[str, Any] = dict(
        env=env,
        buffer_size=WARM_UP * env.num_envs,
        learning_starts=WARM_UP,
        batch_size=BATCH_SIZE,
        train_freq=1,
        gradient_steps=1,
        policy_kwargs=dict(net_arch=[setting.width, setting.width]),
        seed=seed,
        device=device,
    )
    model: OffPolicyAlgorithm
    if setting.algorithm == "TD3":
        model = TD3("MlpPolicy", **common)
    else:
        model = CGP("MlpPolicy", cem_iterations=setting.cem_iterations, cem_samples=setting.cem_samples, **common)
    model.learn(WARM_UP + env.num_envs, log_interval=NO_LOG)
    return model


def measure(args: argparse.Namespace) -> dict[str, Any]:
    """
    Measure the points that the command line asks for.

    :param args: the command line
    :return: under "points", the measurements by axis and value
    """
    points = [
        (axis, value, setting_at(algorithm, axis, value))
        for axis in args.axes
        for value in AXES[axis]
        for algorithm in ("CGP", "TD3")
    ]
    steps = args.gradient_steps
    gradient_runs: dict[Setting, Callable[[], object]] = {}
    learn_runs: dict[Setting, Callable[[], object]] = {}
    for setting in dict.fromkeys(setting for _, _, setting in points):
        env = make_env(setting, args.env, args.seed)
        model = make_model(setting, env, args.seed, args.device)
        gradient_runs[setting] = partial(model.train, steps, BATCH_SIZE)
        if setting.n_envs is not None:
            learn_runs[setting] = partial(model.learn, steps * setting.n_envs, log_interval=NO_LOG, reset_num_timesteps=False)
    gradient_seconds = interleaved(gradient_runs, args.rounds, device=args.device, title="gradient steps")
    learn_seconds = interleaved(learn_runs, args.rounds, device=args.device, title="environment steps")

    measured = []
    for axis, value, setting in points:
        point: dict[str, Any] = {"axis": axis, "value": value, "algorithm": setting.algorithm}
        point["gradient_step_seconds"] = summary([seconds / steps for seconds in gradient_seconds[setting]])
        if setting.n_envs is not None:
            speeds = [steps * setting.n_envs / seconds for seconds in learn_seconds[setting]]
            point["env_steps_per_second"] = summary(speeds)
        measured.append(point)
    return {"points": measured}
