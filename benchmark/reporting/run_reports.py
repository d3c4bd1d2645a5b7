"""The report on a training run of rl_zoo3: its final evaluation, its learning curve, and a record of both."""

from dataclasses import asdict
from typing import Any, cast

import numpy as np
import torch as th
from rl_zoo3 import ALGOS, create_test_env, get_saved_hyperparams
from rl_zoo3.exp_manager import ExperimentManager
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from benchmark.common.environments import import_packages
from benchmark.common.files import write_json
from benchmark.common.provenance import commit, machine, package_versions
from benchmark.reporting.run_curves import Curve, draw_curve, read_curve, training_seconds
from benchmark.reporting.zoo_runs import Run
from sb3_cgp.common.files import write_atomically


def evaluation_env_kwargs(run: Run) -> dict[str, Any]:
    """
    Return the arguments of the run's evaluation environment: the command line's before the YAML file's.

    :param run: the run
    :return: keyword arguments for the environment
    """
    args = run.read_yaml("args.yml")
    return args.get("eval_env_kwargs") or args.get("env_kwargs") or run.read_yaml("config.yml").get("env_kwargs") or {}


def make_env(run: Run, seed: int) -> VecEnv:
    """
    Return the run's evaluation environment, with its wrappers and its normalisation statistics.

    :param run: the run
    :param seed: the environment's seed
    :return: the environment
    """
    import_packages(run.read_yaml("args.yml").get("gym_packages") or [])
    hyperparams, stats_path = get_saved_hyperparams(str(run.settings_folder))
    return create_test_env(
        run.env_name.gym_id,
        stats_path=stats_path,
        seed=seed,
        should_render=False,
        hyperparams=hyperparams,
        env_kwargs=evaluation_env_kwargs(run),
    )


def load_model(run: Run, env: VecEnv, seed: int) -> BaseAlgorithm:
    """
    Load the run's final model for evaluation.

    :param run: the run
    :param env: the evaluation environment, which hindsight replay asks for
    :param seed: seed of the policy's random numbers
    :return: the model
    """
    algorithm = ALGOS[run.algo]
    kwargs: dict[str, Any] = {"seed": seed, "device": run.read_yaml("args.yml").get("device", "auto")}
    if issubclass(algorithm, OffPolicyAlgorithm):
        # An evaluation stores nothing: a full-size replay buffer would only cost memory
        kwargs.update(buffer_size=1, optimize_memory_usage=False)
    if "HerReplayBuffer" in str(run.read_yaml("config.yml").get("replay_buffer_class")):
        kwargs["env"] = env
    return algorithm.load(run.model_path, **kwargs)


def evaluate(run: Run, model: BaseAlgorithm, env: VecEnv, episodes: int) -> list[float]:
    """
    Evaluate a model as rl_zoo3 does: deterministically, except in Atari games and grid worlds.

    :param run: the run
    :param model: the run's model
    :param env: the run's evaluation environment
    :param episodes: the number of episodes
    :return: the undiscounted return of each episode
    """
    env_id = run.env_name.gym_id
    deterministic = not (ExperimentManager.is_atari(env_id) or ExperimentManager.is_minigrid(env_id))
    returns, _ = evaluate_policy(model, env, episodes, deterministic=deterministic, return_episode_rewards=True)
    return [float(episode_return) for episode_return in cast(list[float], returns)]


def gradient_steps(model: BaseAlgorithm) -> int | None:
    """
    Return the number of gradient steps that a model has taken.

    :param model: the model
    :return: those of the critics; None for an on-policy algorithm, which counts epochs
    """
    # SB3 has no other count, and saves it with the model
    return int(model._n_updates) if isinstance(model, OffPolicyAlgorithm) else None


def length_in_words(record: dict[str, Any]) -> str:
    """
    Return the length of a training, as in "4,000 steps, 3,600 gradient steps".

    :param record: the run's record
    :return: environment steps and gradient steps
    """
    number = record["gradient_steps"]
    if number == 0:
        return f"{record['steps']:,} steps, no gradient step: nothing was learnt"
    return f"{record['steps']:,} steps" + ("" if number is None else f", {number:,} gradient steps")


def build_record(run: Run, model: BaseAlgorithm, curve: Curve, returns: list[float], seed: int) -> dict[str, Any]:
    """
    Return the record of a report, with versions and hardware.

    :param run: the run
    :param model: the run's model
    :param curve: the run's learning curve
    :param returns: the returns of the final evaluation
    :param seed: the seed of the final evaluation
    :return: the record
    """
    return {
        "algo": run.algo,
        "env": run.env_name.gym_id,
        "seed": run.read_yaml("args.yml").get("seed"),
        "steps": model.num_timesteps,
        "gradient_steps": gradient_steps(model),
        "hyperparameters": run.read_yaml("config.yml"),
        "final": {
            "episodes": len(returns),
            "seed": seed,
            "mean": np.mean(returns),
            "std": np.std(returns),
            "returns": returns,
        },
        "curve": asdict(curve),
        "seconds_to_last_training_episode": training_seconds(run.folder),
        "commit": commit(),
        "versions": package_versions(),
        "machine": machine(model.device),
    }


def report(run: Run, episodes: int, seed: int) -> dict[str, Any]:
    """
    Evaluate a run and write its learning curve and its record into its folder.

    :param run: the run
    :param episodes: the number of episodes of the final evaluation
    :param seed: the seed of the final evaluation
    :return: the record
    """
    # With the run's number of threads, so that the machine in the record is that of the training, too
    threads = run.read_yaml("args.yml").get("num_threads", -1)
    if threads > 0:
        th.set_num_threads(threads)
    env = make_env(run, seed)
    model = load_model(run, env, seed)
    returns = evaluate(run, model, env, episodes)
    env.close()
    record = build_record(run, model, read_curve(run.folder), returns, seed)
    write_atomically(run.folder / "learning_curve.png", draw_curve(record))
    # Hyperparameters may be any Python object; NumPy's float64 is a float already
    write_json(run.folder / "report.json", record)
    return record


def summary(run: Run, record: dict[str, Any]) -> str:
    """
    Return a few lines on the final evaluation and the files of a run.

    :param run: the run
    :param record: its record
    :return: the lines
    """
    final = record["final"]
    return "\n".join(
        [
            f"{record['algo']} on {record['env']}, seed {record['seed']}, after {length_in_words(record)}",
            f"  final evaluation  {final['mean']:.1f} ± {final['std']:.1f} over {final['episodes']} episodes",
            f"  model             {run.model_path}",
            f"  logs              {run.folder}",
            f"  learning curve    {run.folder / 'learning_curve.png'}",
            f"  record            {run.folder / 'report.json'}",
        ]
    )
