"""Every variant and selector learns: the paper's five and three selectors on Pendulum, and CGP on a MuJoCo task."""

import pytest
from learning import SWUNG_UP, median_return
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from benchmark.speed.training import train_by_zoo
from sb3_cgp.selectors import MPPI, ActorOnly, ActorStart

pytestmark = pytest.mark.slow

VARIANTS = {
    "CGP-Online": dict(policy_loss="cgp"),
    "CGP-Offline": dict(policy_loss="cgp", policy_training="offline"),
    "QGP-Online": dict(policy_loss="qgp"),
    "QGP-Offline": dict(policy_loss="qgp", policy_training="offline"),
    "CEM": dict(policy_loss=None),
    "CGP-Light": dict(cem_start="actor", cem_iterations=1, cem_samples=16),
    "MPPI": dict(policy_kwargs=dict(net_arch=[64, 64], selector=MPPI(1, 16, start=ActorStart())), cem_dtype="float32"),
    # TD3, which explores by the task's action noise
    "ActorOnly": dict(policy_kwargs=dict(net_arch=[64, 64], selector=ActorOnly()), policy_loss="qgp", policy_delay=2),
}


def mean_return(env_id, seed, device="cpu", **variant):
    """Train as `rl_zoo3.train --algo cgp` does, and evaluate over 20 episodes."""
    model = train_by_zoo(env_id, variant, seed=seed, device=device)
    return evaluate_policy(model, make_vec_env(env_id, seed=1_000), n_eval_episodes=20)[0]


@pytest.mark.parametrize("variant", VARIANTS)
def test_every_variant_swings_up_the_pendulum(variant):
    assert median_return(lambda seed: mean_return("Pendulum-v1", seed, **VARIANTS[variant]), least=SWUNG_UP) >= SWUNG_UP


def test_cgp_reaches_on_mujoco():
    # Random torques earn about -43, none at all -12
    assert mean_return("Reacher-v5", seed=0) >= -10


@pytest.mark.usefixtures("gpu")
def test_cuda_graphs_swing_up_the_pendulum():
    assert median_return(lambda seed: mean_return("Pendulum-v1", seed, device="cuda"), least=SWUNG_UP) >= SWUNG_UP
