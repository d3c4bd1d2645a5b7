"""Small models whose gradient steps are CUDA graphs, and a stand-in for a graph where there is no GPU."""

import numpy as np
import torch as th
from stable_baselines3.common.noise import NormalActionNoise

from sb3_cgp import CGP
from sb3_cgp.fast import cuda_graphs

# Learning rates are powers of two: a recorded one is a float32
SMALL = dict(
    cuda_graphs=True,
    learning_rate=2**-10,
    learning_starts=30,
    buffer_size=1_000,
    batch_size=16,
    cem_samples=8,
    cem_elites=2,
    seed=0,
)
VARIANTS = {
    "CGP-Online": dict(),
    "CGP-Offline": dict(policy_training="offline"),
    "QGP-Online": dict(policy_loss="qgp"),
    "CEM": dict(policy_loss=None),
    "CGP-Light": dict(cem_start="actor", cem_iterations=1),
    "from the actor, offline": dict(cem_start="actor", policy_training="offline"),
    "delays": dict(policy_delay=3, target_update_interval=4),
    "n-step": dict(n_steps=3),
    "schedules": dict(
        learning_rate=lambda progress: 2 ** -round(10 - 4 * progress),
        actor_learning_rate=lambda progress: 2 ** -round(12 - 6 * progress),
    ),
    "noise": dict(action_noise=NormalActionNoise(np.zeros(1), 0.1 * np.ones(1))),
}


class StandIn:
    """Does what a recording does, by calling the function; Python's part of it has no effect, as in a replay."""

    made = 0

    def __init__(self, function, inputs):
        StandIn.made += 1
        self.function, self.inputs = function, cuda_graphs.clone_all(inputs)

    fits = cuda_graphs.Recording.fits

    @property
    def _inputs(self):
        return self.inputs

    def replay(self, inputs):
        for recorded, new in zip(self.inputs, inputs, strict=True):
            if recorded is not None:
                recorded.copy_(new)
        model = getattr(getattr(self.function, "func", None), "__self__", None)
        attributes = {} if model is None else dict(vars(model))
        outputs = cuda_graphs.clone_all(self.function(*self.inputs))
        if model is not None:
            vars(model).clear()
            vars(model).update(attributes)
        return outputs


def make_model(**kwargs):
    return CGP("MlpPolicy", "Pendulum-v1", policy_kwargs=dict(net_arch=[16]), **(SMALL | kwargs))


def parameters(model):
    return th.cat([parameter.detach().flatten().cpu() for parameter in model.policy.parameters()])
