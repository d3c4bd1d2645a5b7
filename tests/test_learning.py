"""Every variant learns: the paper's five on Pendulum, and CGP on a MuJoCo task."""

import pytest
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from benchmark.speed.training import train_by_zoo

pytestmark = pytest.mark.slow

VARIANTS = {
    "CGP-Online": dict(policy_loss="cgp"),
    "CGP-Offline": dict(policy_loss="cgp", policy_training="offline"),
    "QGP-Online": dict(policy_loss="qgp"),
    "QGP-Offline": dict(policy_loss="qgp", policy_training="offline"),
    "CEM": dict(policy_loss=None),
}


def mean_return(env_id, device="cpu", **variant):
    """Train as `rl_zoo3.train --algo cgp` does, and evaluate over 20 episodes."""
    model = train_by_zoo(env_id, variant, seed=0, device=device)
    return evaluate_policy(model, make_vec_env(env_id, seed=1_000), n_eval_episodes=20)[0]


@pytest.mark.parametrize("variant", VARIANTS)
def test_every_variant_swings_up_the_pendulum(variant):
    # Random actions earn about -1200, the best known policies about -150
    assert mean_return("Pendulum-v1", **VARIANTS[variant]) >= -200


def test_cgp_reaches_on_mujoco():
    # Random torques earn about -43, none at all -12
    assert mean_return("Reacher-v5") >= -10


@pytest.mark.usefixtures("gpu")
def test_cuda_graphs_swing_up_the_pendulum():
    assert mean_return("Pendulum-v1", device="cuda") >= -200
