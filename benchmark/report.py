"""
Report on one training run of rl_zoo3: final evaluation, learning curve, and a record of both.

``python -m benchmark.report --algo cgp --env Pendulum-v1`` takes the latest run, evaluates its final model,
and writes ``learning_curve.png`` and ``report.json`` into the run's folder.
"""

import argparse
import importlib
import io
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd
import torch as th
import yaml
from huggingface_sb3 import EnvironmentName
from matplotlib.figure import Figure
from rl_zoo3 import ALGOS, create_test_env, get_latest_run_id, get_saved_hyperparams
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.utils import get_model_path
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import get_monitor_files, load_results
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from benchmark.common.files import write_json
from benchmark.common.provenance import commit, machine, package_versions
from sb3_cgp.common.files import write_atomically

# Far from the seeds that people train with: rl_zoo3 gives the training's environments the run's own
EVALUATION_SEED = 10_000
# A curve drawn from training episodes joins them into at most so many points
TRAINING_POINTS = 50


@dataclass(frozen=True)
class Run:
    """
    A finished training run, as rl_zoo3 left it.

    :param algo: the algorithm's name in rl_zoo3
    :param env_name: the environment
    :param folder: the run's folder
    :param model_path: the final model
    """

    algo: str
    env_name: EnvironmentName
    folder: Path
    model_path: Path

    @property
    def settings_folder(self) -> Path:
        """The folder of the hyperparameters, the command line and the normalisation statistics."""
        return self.folder / self.env_name

    def read_yaml(self, name: str) -> dict[str, Any]:
        """
        Read what rl_zoo3 saved about the run.

        :param name: ``config.yml`` (the hyperparameters) or ``args.yml`` (the command line)
        :return: the file's content; empty if there is no such file
        """
        path = self.settings_folder / name
        if not path.is_file():
            return {}
        # rl_zoo3 writes OrderedDicts and tuples, which only the unsafe loader reads, as rl_zoo3 does itself
        return dict(yaml.load(path.read_text(), Loader=yaml.UnsafeLoader))


@dataclass(frozen=True)
class Curve:
    """
    Returns against training steps.

    :param source: what the returns come from, in words
    :param timesteps: environment steps at each point
    :param mean: mean return at each point
    :param std: standard deviation over a point's episodes
    """

    source: str
    timesteps: list[int]
    mean: list[float]
    std: list[float]

    @classmethod
    def from_returns(cls, source: str, timesteps: Sequence[int], returns: Sequence[np.ndarray]) -> "Curve":
        """
        Make a curve from the returns of each point's episodes.

        :param source: what the returns come from, in words
        :param timesteps: environment steps at each point
        :param returns: the returns of the episodes at each point
        :return: the curve
        """
        return cls(
            source,
            [int(timestep) for timestep in timesteps],
            [float(np.mean(point)) for point in returns],
            [float(np.std(point)) for point in returns],
        )


def find_run(folder: str, algo: str, env_id: str, exp_id: int = 0) -> Run:
    """
    Find a run where rl_zoo3 puts it.

    :param folder: rl_zoo3's log folder
    :param algo: the algorithm's name in rl_zoo3
    :param env_id: the environment
    :param exp_id: the run's number; 0 for the latest
    :return: the run
    :raises FileNotFoundError: if there is no such run, or it has no final model
    """
    env_name = EnvironmentName(env_id)
    runs = Path(folder) / algo
    exp_id = exp_id or get_latest_run_id(str(runs), env_name)
    if exp_id == 0:
        raise FileNotFoundError(
            f"No run of {algo} on {env_id} in {runs}: train one with `make train ALGO={algo} ENV={env_id}`, "
            "or name another log folder with --folder"
        )
    try:
        _, model_path, run_folder = get_model_path(exp_id, folder, algo, env_name)
    except (AssertionError, ValueError) as error:
        raise FileNotFoundError(
            f"No trained model in {runs / f'{env_name}_{exp_id}'}: wait until its training has ended, "
            "or name another run with --exp-id"
        ) from error
    return Run(algo, env_name, Path(run_folder), Path(model_path))


def run_in(folder: Path) -> Run:
    """
    Find the run of a folder.

    :param folder: the run's folder
    :return: the run
    :raises FileNotFoundError: if it is no run's folder, or has no final model
    """
    settings = next(folder.glob("*/args.yml"), None)
    if settings is None:
        raise FileNotFoundError(f"{folder} is no folder of a run, such as logs/cgp/Pendulum-v1_1: no args.yml in it")
    model_path = folder / f"{settings.parent.name}.zip"
    if not model_path.is_file():
        raise FileNotFoundError(f"No trained model in {folder}: wait until its training has ended")
    args = yaml.load(settings.read_text(), Loader=yaml.UnsafeLoader)
    return Run(args["algo"], EnvironmentName(args["env"]), folder, model_path)


def evaluation_env_kwargs(run: Run) -> dict[str, Any]:
    """
    Collect the arguments of the run's evaluation environment: the command line's before the YAML file's.

    :param run: the run
    :return: keyword arguments for the environment
    """
    args = run.read_yaml("args.yml")
    return args.get("eval_env_kwargs") or args.get("env_kwargs") or run.read_yaml("config.yml").get("env_kwargs") or {}


def make_env(run: Run, seed: int) -> VecEnv:
    """
    Make the run's evaluation environment, with its wrappers and its normalisation statistics.

    :param run: the run
    :param seed: the environment's seed
    :return: the environment
    """
    for package in run.read_yaml("args.yml").get("gym_packages") or []:
        importlib.import_module(package)
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


def read_training_episodes(folder: Path) -> pd.DataFrame:
    """
    Read the episodes that SB3's monitors recorded while the run trained.

    :param folder: the run's folder
    :return: return (r), length (l) and end in seconds since the start (t) of each; empty if nothing was recorded
    """
    if not get_monitor_files(str(folder)):
        return pd.DataFrame(columns=["r", "l", "t"])
    return load_results(str(folder))


def read_curve(folder: Path) -> Curve:
    """
    Read a run's learning curve: its evaluations, or its training episodes if it was not evaluated.

    :param folder: the run's folder
    :return: the curve; without points if nothing was recorded
    """
    evaluations = folder / "evaluations.npz"
    if evaluations.is_file():
        with np.load(evaluations) as saved:
            return Curve.from_returns("evaluations", saved["timesteps"], saved["results"])

    episodes = read_training_episodes(folder)
    points = np.array_split(np.arange(len(episodes)), min(len(episodes), TRAINING_POINTS)) if len(episodes) > 0 else []
    steps, returns = episodes["l"].cumsum().to_numpy(), episodes["r"].to_numpy()
    return Curve.from_returns(
        "training episodes", [steps[point[-1]] for point in points], [returns[point] for point in points]
    )


def training_seconds(folder: Path) -> float | None:
    """
    Read how long a run took, from the making of its environments to the end of its last training episode,
    evaluations included. What comes after, such as CGP's offline policy training, is not in it.

    :param folder: the run's folder
    :return: wall-clock seconds; None if no episode was recorded
    """
    episodes = read_training_episodes(folder)
    return float(episodes["t"].max()) if len(episodes) > 0 else None


def build_record(run: Run, model: BaseAlgorithm, curve: Curve, returns: list[float], seed: int) -> dict[str, Any]:
    """
    Put together everything that the report says, with what it was measured with.

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


def draw_curve(record: dict[str, Any]) -> bytes:
    """
    Draw a learning curve, its mean with a band of one standard deviation over episodes, and the final evaluation.

    :param record: the run's record
    :return: the picture, as PNG
    """
    curve, final = record["curve"], record["final"]
    mean, std = np.array(curve["mean"]), np.array(curve["std"])
    # No pyplot: its global figure list and its choice of a screen back-end are of no use here
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.add_subplot()
    (line,) = axes.plot(curve["timesteps"], mean, label=f"{curve['source']}, mean ± std")
    axes.fill_between(curve["timesteps"], mean - std, mean + std, alpha=0.2, color=line.get_color())
    axes.errorbar(
        record["steps"], final["mean"], final["std"], fmt="o", capsize=4, label=f"final model, {final['episodes']} episodes"
    )
    axes.set(title=f"{record['algo']} on {record['env']}, seed {record['seed']}", xlabel="environment steps", ylabel="return")
    axes.grid(alpha=0.3)
    axes.legend()
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=150)
    return picture.getvalue()


def report(run: Run, episodes: int, seed: int) -> dict[str, Any]:
    """
    Evaluate a run and write its learning curve and its record into its folder.

    :param run: the run
    :param episodes: the number of episodes of the final evaluation
    :param seed: the seed of the final evaluation
    :return: the record
    """
    # As many threads as the run trained with, so that what the record says of the machine holds for both
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
    Say in a few lines how a run ended and where everything lies.

    :param run: the run
    :param record: its record
    :return: the lines
    """
    final = record["final"]
    return "\n".join(
        [
            f"{record['algo']} on {record['env']}, seed {record['seed']}, after {record['steps']:,} steps",
            f"  final evaluation  {final['mean']:.1f} ± {final['std']:.1f} over {final['episodes']} episodes",
            f"  model             {run.model_path}",
            f"  logs              {run.folder}",
            f"  learning curve    {run.folder / 'learning_curve.png'}",
            f"  record            {run.folder / 'report.json'}",
        ]
    )


def main(argv: Sequence[str] | None = None) -> None:
    """
    Report on the run that the command line names.

    :param argv: the command line; None for the process's own
    """
    parser = argparse.ArgumentParser(prog="python -m benchmark.report", description="Report on a training run of rl_zoo3.")
    parser.add_argument("--algo", default="cgp", choices=list(ALGOS), help="algorithm (default: %(default)s)")
    parser.add_argument("--env", default="Pendulum-v1", help="environment (default: %(default)s)")
    parser.add_argument("--folder", default="logs", help="rl_zoo3's log folder (default: %(default)s)")
    parser.add_argument("--exp-id", default=0, type=int, help="number of the run (default: 0, the latest)")
    parser.add_argument("--run", type=Path, help="the run's folder, in place of the four above")
    parser.add_argument("--episodes", default=20, type=int, help="episodes of the final evaluation (default: %(default)s)")
    parser.add_argument(
        "--seed", default=EVALUATION_SEED, type=int, help="seed of the final evaluation (default: %(default)s)"
    )
    args = parser.parse_args(argv)
    try:
        run = run_in(args.run) if args.run else find_run(args.folder, args.algo, args.env, args.exp_id)
    except FileNotFoundError as error:
        sys.exit(f"Error: {error}")
    print(summary(run, report(run, args.episodes, args.seed)))


if __name__ == "__main__":
    main()
