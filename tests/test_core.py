"""The core alone: no other package but `common` can be imported, and the core trains as the whole package does."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch as th
from learning import SWUNG_UP, median_return

import sb3_cgp
from sb3_cgp import CGP
from sb3_cgp.core import cgp, policies

OTHERS = sorted(
    path.stem
    for path in Path(sb3_cgp.__file__).parent.iterdir()
    if (path.is_dir() or path.suffix == ".py")
    and path.stem not in ("__init__", "__pycache__", "core", "common", "hyperparams")
)
ARGUMENTS = dict(
    env="Pendulum-v1", learning_starts=50, buffer_size=1_000, batch_size=16, cem_samples=8, cem_elites=2, seed=0, device="cpu"
)
ALONE = """
import sys, types
import torch as th

package = types.ModuleType("sb3_cgp")
package.__path__ = [{package!r}]
sys.modules["sb3_cgp"] = package
blocked = [f"sb3_cgp.{{other}}" for other in {others!r}] + ["rl_zoo3", "optuna", "filelock"]


class Block:
    @staticmethod
    def find_spec(name, path=None, target=None):
        if any(f"{{name}}.".startswith(f"{{each}}.") for each in blocked):
            raise ImportError(f"{{name}} is blocked")


sys.meta_path.insert(0, Block)
th.set_num_threads(1)
from sb3_cgp.core.cgp import CGP

{training}
assert not any(name in sys.modules for name in blocked)
try:
    import sb3_cgp.fast.scoring
except ImportError:
    sys.exit(0)
sys.exit("nothing is blocked")
"""
TRAINING = """
for name, variant in {variants!r}.items():
    model = CGP("MlpPolicy", policy_kwargs=dict(net_arch=[16, 16]), **{arguments!r}, **variant).learn(150)
    th.save(model.policy.state_dict(), {folder!r} + f"/{{name}}.pt")
    assert model._n_updates == 100
"""
LEARNING = """
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

model = CGP(
    "MlpPolicy", make_vec_env("Pendulum-v1", seed=0), learning_rate=lambda remaining: 2e-3 * remaining, batch_size=64,
    gamma=0.98, tau=0.02, learning_starts=2_000, policy_kwargs=dict(net_arch=[64, 64]), seed={seed}, device="cpu",
).learn(10_000)
print(evaluate_policy(model, make_vec_env("Pendulum-v1", seed=1_000), n_eval_episodes=20)[0], flush=True)
"""
VARIANTS = {"CGP": dict(), "QGP": dict(policy_loss="qgp", policy_delay=2), "CEM": dict(policy_loss=None)}


def run_alone(training):
    """Run a script in a process in which no other package can be imported, and return what it prints."""
    script = ALONE.format(package=str(Path(sb3_cgp.__file__).parent), others=OTHERS, training=training)
    return subprocess.run([sys.executable, "-c", script], check=True, stdout=subprocess.PIPE, text=True).stdout


def test_the_core_trains_alone_as_the_whole_package_does(tmp_path):
    """One test of all variants, as one process trains them alone."""
    assert {"algorithm", "fast", "guards", "resumption", "export", "zoo", "diagnostics"} <= set(OTHERS)
    run_alone(TRAINING.format(arguments=ARGUMENTS, variants=VARIANTS, folder=str(tmp_path)))
    for variant, kwargs in VARIANTS.items():
        alone = th.load(tmp_path / f"{variant}.pt")
        assert alone, variant

        # With the core's own scoring, the other packages change no bit
        whole = CGP(policies.CGPPolicy, policy_kwargs=dict(net_arch=[16, 16]), **ARGUMENTS, **kwargs).learn(150)
        for name, value in alone.items():
            assert th.equal(whole.policy.state_dict()[name], value), f"{variant}: {name}"

        # With the fast one, values differ by rounding alone
        fast = CGP("MlpPolicy", policy_kwargs=dict(net_arch=[16, 16]), cem_dtype="float32", **ARGUMENTS, **kwargs).learn(150)
        for name, value in alone.items():
            message = f"{variant}: {name}"
            th.testing.assert_close(fast.policy.state_dict()[name], value, rtol=1e-3, atol=1e-4, msg=message)


def test_the_core_takes_every_argument_of_the_whole_that_is_its_own():
    model = cgp.CGP("MlpPolicy", policy_kwargs=dict(net_arch=[8]), tau=0.1, gamma=0.9, n_steps=3, verbose=0, **ARGUMENTS)
    assert (model.tau, model.gamma, model.replay_buffer.n_steps) == (0.1, 0.9, 3)
    action, _ = model.predict(np.zeros(3, np.float32))
    assert action.shape == (1,)


def test_the_core_is_read_in_a_sitting():
    # 700 lines, of which 28 are the paper's two losses: a loss of one's own may be added to those
    files = [path for path in Path(cgp.__file__).parent.glob("*.py") if path.name != "losses.py"]
    assert sum(len(path.read_text().splitlines()) for path in files) <= 672


@pytest.mark.slow
def test_the_core_alone_swings_up_the_pendulum():
    assert median_return(lambda seed: float(run_alone(LEARNING.format(seed=seed))), least=SWUNG_UP) >= SWUNG_UP
