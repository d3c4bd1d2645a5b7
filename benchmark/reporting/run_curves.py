"""The learning curve of a training run of rl_zoo3, as its evaluations or its monitors recorded it."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from stable_baselines3.common.monitor import get_monitor_files, load_results

from benchmark.common.canvas import BAND, count_steps, legend, panels, png, styled
from benchmark.common.style import METHODS

# A curve drawn from training episodes joins them into at most so many points
TRAINING_POINTS = 50


@dataclass(frozen=True)
class Curve:
    """
    Returns against training steps.

    :param source: the origin of the returns, as text
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
        Return the curve of the returns of each point's episodes.

        :param source: the origin of the returns, as text
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


@styled
def draw_curve(record: dict[str, Any]) -> bytes:
    """
    Draw a learning curve, its mean with a band of one standard deviation over episodes, and the final evaluation.

    :param record: the run's record
    :return: the picture, as PNG
    """
    curve, final = record["curve"], record["final"]
    steps, mean, std = (np.array(curve[name], dtype=float) for name in ("timesteps", "mean", "std"))
    figure, (panel,) = panels(1, size=(5.6, 3.4))
    color = METHODS["CGP-Online"]["color"]
    panel.plot(steps, mean, label=f"{curve['source']}, mean ± std", color=color)
    panel.fill_between(steps, mean - std, mean + std, color=color, **BAND)
    label = f"final model, {final['episodes']} episodes"
    panel.errorbar(record["steps"], final["mean"], final["std"], fmt="o", capsize=4, label=label, color="black", clip_on=False)
    panel.set(title=f"{record['algo']} on {record['env']}, seed {record['seed']}", ylabel="return")
    count_steps([panel])
    legend(figure, [panel])
    return png(figure)
