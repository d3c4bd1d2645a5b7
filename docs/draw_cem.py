"""
Draw docs/images/cem.gif: CEM climbs a learnt Q-function over two action dimensions, beside the actor's action.

`python docs/draw_cem.py`, in the clone after `make train`, trains CGP on Reacher-v5 for a minute and draws one state.
"""

import argparse
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch as th
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm
from matplotlib.lines import Line2D
from PIL import Image

from sb3_cgp import CEM, CGP

ITERATIONS = 4
STAGES = ("draw 64 samples", "keep the 6 best", "fit the next Gaussian")
TICKS = (-1, -0.5, 0, 0.5, 1)
# In the legend's order; colours of Okabe and Ito's palette
MARKERS: dict[str, dict[str, Any]] = {
    "samples": dict(linestyle="", marker=".", color="white", markersize=6, markeredgecolor="black", markeredgewidth=0.4),
    "elites": dict(linestyle="", marker="o", color="#E69F00", markersize=8, markeredgecolor="black"),
    "Gaussian (2 std)": dict(color="black"),
    "CEM's action": dict(linestyle="", marker="D", color="#E69F00", markersize=10, markeredgecolor="black"),
    "actor's action": dict(linestyle="", marker="*", color="#D55E00", markersize=17, markeredgecolor="white"),
}


def train(steps: int, seed: int) -> CGP:
    """Return CGP, trained on Reacher-v5 by the hyperparameters of hyperparams/cgp.yml, with fewer random steps."""
    arguments = dict(learning_rate="lin_1e-3", batch_size=64, gamma=0.98, tau=0.02, policy_kwargs=dict(net_arch=[64, 64]))
    model = CGP("MlpPolicy", "Reacher-v5", learning_starts=1_000, cem_dtype="float32", seed=seed, device="cpu", **arguments)
    return model.learn(steps)


def first_state(model: CGP, seed: int) -> th.Tensor:
    """Return the first observation of the episode with this seed, shape (1, observation size)."""
    env = model.get_env()
    env.seed(seed)
    return th.as_tensor(env.reset(), dtype=th.float32)


class Search:
    """One search of CEM for the best action of a state, and the values of all actions on a grid."""

    def __init__(self, model: CGP, state: th.Tensor):
        features = model.critic.extract_features(state, model.critic.features_extractor)
        score = model.policy.make_score(model.critic.q_networks[0], features)
        self.samples: list[np.ndarray] = []
        self.elites: list[np.ndarray] = []

        def recording_score(actions: th.Tensor) -> th.Tensor:
            values = score(actions)
            self.samples.append(actions[0].numpy())
            self.elites.append(actions[0, values[0].topk(selector.elites).indices].numpy())
            return values

        selector = CEM(iterations=ITERATIONS)
        with th.no_grad():
            self.action = selector.select(recording_score, n_states=1, action_dim=2).actions[0].numpy()
            self.actor_action = model.actor(state)[0].numpy()
            self.grid = np.linspace(-1, 1, 101, dtype=np.float32)
            pairs = np.stack(np.meshgrid(self.grid, self.grid), axis=-1).reshape(1, -1, 2)
            self.values = score(th.as_tensor(pairs)).view(len(self.grid), len(self.grid)).numpy()


def draw(axes: Axes, search: Search, frame: int) -> None:
    """Draw a frame: three stages for each iteration, and the selected action at the end."""
    axes.clear()
    lowest, highest = search.values.min(), search.values.max()
    # Denser near the maximum, where CEM searches
    levels = highest - (highest - lowest) * np.linspace(1, 0, 25) ** 2
    axes.contourf(search.grid, search.grid, search.values, levels=levels, cmap="viridis", norm=BoundaryNorm(levels, 256))
    axes.set(xlim=(-1, 1), ylim=(-1, 1), aspect="equal", xticks=TICKS, yticks=TICKS)
    axes.set(xlabel="action, dimension 1", ylabel="action, dimension 2")
    axes.plot(*search.actor_action, **MARKERS["actor's action"])
    if frame == ITERATIONS * len(STAGES):
        axes.plot(*search.action, **MARKERS["CEM's action"])
        axes.set_title("CEM returns the best sample of its last iteration")
    else:
        iteration, stage = divmod(frame, len(STAGES))
        draw_iteration(axes, search.samples[iteration], search.elites[iteration], stage)
        axes.set_title(f"Iteration {iteration + 1} of {ITERATIONS}: {STAGES[stage]}")


def draw_iteration(axes: Axes, samples: np.ndarray, elites: np.ndarray, stage: int) -> None:
    """Draw the samples, from the second stage on the elites, and in the third the Gaussian that is fitted to them."""
    axes.plot(*samples.T, **MARKERS["samples"])
    if stage >= 1:
        axes.plot(*elites.T, **MARKERS["elites"])
    if stage == 2:
        # The Gaussian is fitted before tanh
        points = np.arctanh(elites.astype(float).clip(-0.9999, 0.9999))
        angles = np.linspace(0, 2 * np.pi, 100)
        circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        ellipse = np.tanh(points.mean(axis=0) + 2 * points.std(axis=0) * circle)
        axes.plot(*ellipse.T, **MARKERS["Gaussian (2 std)"])


def write_gif(search: Search, path: Path) -> None:
    """Write the animation, with one palette of 128 colours for all frames to keep the file small."""
    plt.rcParams.update({"font.size": 12})
    figure, axes = plt.subplots(figsize=(5.6, 6.1), dpi=90)
    figure.subplots_adjust(left=0.14, right=0.96, bottom=0.21, top=0.95)
    keys = [Line2D([], [], label=name, **style) for name, style in MARKERS.items()]
    # Grey, as white samples need a background
    figure.legend(handles=keys, loc="lower center", ncols=3, frameon=True, facecolor="#DDDDDD")
    n_frames = ITERATIONS * len(STAGES) + 1
    FuncAnimation(figure, lambda frame: draw(axes, search, frame), frames=n_frames).save(path, PillowWriter(fps=1))
    with Image.open(path) as drawn:
        frames = []
        for frame in range(n_frames):
            drawn.seek(frame)
            frames.append(drawn.convert("RGB"))
    palette = frames[2].quantize(128, dither=Image.Dither.NONE)
    small = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    durations = [1_000] * (n_frames - 1) + [3_000]
    small[0].save(path, save_all=True, append_images=small[1:], duration=durations, loop=0, optimize=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=8_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--path", type=Path, default=Path(__file__).parent / "images" / "cem.gif")
    arguments = parser.parse_args()
    th.set_num_threads(1)
    model = train(arguments.steps, arguments.seed)
    th.manual_seed(arguments.seed)
    write_gif(Search(model, first_state(model, arguments.seed)), arguments.path)
    print(f"Wrote {arguments.path}")
