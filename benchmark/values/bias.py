"""The bias of a critic's values, measured along the training."""

from contextlib import nullcontext
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3 import TD3
from stable_baselines3.common.callbacks import BaseCallback

from benchmark.common.records import EVALUATION_SEED
from benchmark.values.episodes import Episode, error_bounds, n_counted, play, returns_to_go
from sb3_cgp import CGP
from sb3_cgp.common.random_state import preserved_random_state


@th.no_grad()
def critic_values(model: CGP | TD3, observations: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """
    Return each critic's values of states and actions.

    :param model: the model
    :param observations: the states' observations, shape (T, O)
    :param actions: the actions in the environment's bounds, shape (T, A)
    :return: the values, shape (T, number of critics)
    """
    scaled = th.as_tensor(model.policy.scale_action(actions), dtype=th.float32, device=model.device)
    tensors, _ = model.policy.obs_to_tensor(observations)
    return th.cat(model.critic(tensors, scaled), dim=1).cpu().numpy()


def measure(model: CGP | TD3, episodes: list[Episode]) -> dict[str, Any]:
    """
    Compare the critic's values with the discounted returns of episodes.

    :param model: the model
    :param episodes: episodes of one policy
    :return: means over the episodes of their return (not discounted) and length; means over the counted states, of which
        ``n_states`` is the number, of the first critic's value, the minimum of all critics, the discounted return and the
        bound of its error. The latter are None if no state counts.
    """
    counts = [n_counted(episode, model.gamma) for episode in episodes]
    summary: dict[str, Any] = {
        "return": float(np.mean([sum(episode.rewards) for episode in episodes])),
        "length": float(np.mean([len(episode.rewards) for episode in episodes])),
        "n_states": sum(counts),
    }
    if not any(counts):
        return summary | dict.fromkeys(("q1", "q_min", "discounted_return", "error_bound"))
    counted = list(zip(episodes, counts, strict=True))
    observations = np.concatenate([episode.observations[:count] for episode, count in counted if count])
    actions = np.concatenate([episode.actions[:count] for episode, count in counted if count])
    values = critic_values(model, observations, actions)
    returns = [returns_to_go(episode.rewards, model.gamma)[:count] for episode, count in counted]
    return summary | {
        "q1": float(values[:, 0].mean()),
        "q_min": float(values.min(axis=1).mean()),
        "discounted_return": float(np.concatenate(returns).mean()),
        "error_bound": float(np.concatenate([error_bounds(episode, model.gamma) for episode in episodes]).mean()),
    }


class BiasCallback(BaseCallback):
    """
    Measure the bias of the critic along the training, and leave the training's random numbers as they are.

    :param env_id: the environment
    :param interval: environment steps between two measurements
    :param n_episodes: number of episodes of each policy per measurement, from the same initial states each time
    :param episode_steps: time limit of these episodes, in steps
    """

    def __init__(self, env_id: str, interval: int, n_episodes: int, episode_steps: int):
        super().__init__()
        self.interval = interval
        self.envs = [gym.make(env_id, max_episode_steps=episode_steps) for _ in range(n_episodes)]
        self.points: list[dict[str, Any]] = []

    def _on_step(self) -> bool:
        if self.num_timesteps % self.interval == 0 and self.num_timesteps > self.model.learning_starts:  # type: ignore[attr-defined]
            with preserved_random_state(self.model.device):
                self.points.append({"steps": self.num_timesteps} | self._measure_policies())
        return True

    def _measure_policies(self) -> dict[str, Any]:
        """Measure along the actor's episodes, and along those of CEM, whose values the critics of CGP learn."""
        assert isinstance(self.model, (CGP, TD3))
        measured = {}
        for name in ("actor", "cem") if isinstance(self.model, CGP) else ("actor",):
            acting = self.model.policy.acting_by(name) if isinstance(self.model, CGP) else nullcontext()
            with acting:
                measured[name] = measure(self.model, play(self._act, self.envs, EVALUATION_SEED))
        return measured

    def _act(self, observations: np.ndarray) -> np.ndarray:
        return self.model.predict(observations, deterministic=True)[0]

    def _on_training_end(self) -> None:
        for env in self.envs:
            env.close()
