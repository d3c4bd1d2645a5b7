"""gSDE's noise, which SB3 draws when a rollout starts, goes on in a resumed training as in a straight one."""

import numpy as np
import pytest
import stable_baselines3 as sb3
from stable_baselines3.common.env_util import make_vec_env
from trainings import Do, Interruption, parameters_equal

from sb3_cgp.resumption import TrainingCheckpointCallback, resumable

contrib = pytest.importorskip("sb3_contrib")

ARGUMENTS = dict(learning_starts=10, batch_size=8, buffer_size=1000, policy_kwargs=dict(net_arch=[8]), seed=0, use_sde=True)


def raise_interruption():
    raise Interruption


@pytest.mark.parametrize(
    ("algorithm", "n_envs", "arguments"),
    [
        (sb3.SAC, 1, dict()),
        (sb3.SAC, 2, dict(sde_sample_freq=2, train_freq=5)),
        (contrib.TQC, 1, dict(use_sde_at_warmup=True)),
        (contrib.CrossQ, 2, dict()),
    ],
)
@pytest.mark.parametrize("stop", [23, 60], ids=["within a rollout", "at the end"])
def test_noise_of_the_interrupted_rollout_is_drawn_again(algorithm, n_envs, arguments, stop, tmp_path):
    algorithm = resumable(algorithm)

    def make():
        return algorithm("MlpPolicy", make_vec_env("Pendulum-v1", n_envs, seed=0), **ARGUMENTS | arguments)

    straight = make().learn(100)
    checkpoint = TrainingCheckpointCallback(10, tmp_path)
    if stop == 23:
        with pytest.raises(Interruption):
            make().learn(100, [checkpoint, Do(stop, raise_interruption)])
    else:
        make().learn(stop, checkpoint)
    resumed = algorithm.resume(tmp_path, make_vec_env("Pendulum-v1", n_envs, seed=5)).learn(100)
    np.testing.assert_array_equal(resumed.replay_buffer.actions[:50], straight.replay_buffer.actions[:50])
    assert parameters_equal(resumed, straight)
