"""Action noise that does not fit a model, or was made for another number of environments."""

import copy
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.noise import ActionNoise, VectorizedActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_cgp.common.rules import require


def fit_action_noise(model: OffPolicyAlgorithm) -> None:
    """
    Adapt action noise to the number of environments, which `load` may have changed, or for which a callback did not set it.

    :param model: the model, with an environment
    """
    assert model.env is not None
    noise, n_envs = model.action_noise, model.env.num_envs
    n_noises = len(noise.noises) if isinstance(noise, VectorizedActionNoise) else 1
    if noise is None or n_noises == n_envs:
        return
    base = copy.deepcopy(noise.base_noise if isinstance(noise, VectorizedActionNoise) else noise)
    model.action_noise = base if n_envs == 1 else VectorizedActionNoise(base, n_envs)


def check_action_noise(noise: Any, action_space: spaces.Space) -> None:
    """
    Check that exploration noise is such, and can be added to an action.

    :param noise: the argument ``action_noise``; the shape of noise of another class than SB3's is not checked
    :param action_space: the action space
    :raises ValueError: if it is neither None nor action noise, or of another shape
    """
    allowed = "None or an ActionNoise, such as NormalActionNoise(np.zeros(n), 0.1 * np.ones(n)) for n action dimensions"
    require(isinstance(noise, ActionNoise | None), "action_noise", noise, allowed)
    base = noise.base_noise if isinstance(noise, VectorizedActionNoise) else noise
    for name in ("_mu", "_sigma"):
        # SB3 gives no public access to the mean and the standard deviation
        shape = np.shape(getattr(base, name, 0.0))
        allowed = f"noise of the actions' shape, {action_space.shape}, not {shape}"
        require(_broadcasts_to(shape, action_space.shape or ()), "action_noise", noise, allowed)


def _broadcasts_to(shape: tuple[int, ...], other: tuple[int, ...]) -> bool:
    """Return whether NumPy broadcasts an array of a shape to another one."""
    try:
        return np.broadcast_shapes(shape, other) == other
    except ValueError:
        return False
