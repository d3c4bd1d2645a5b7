"""CGP models that train in a second, one of every variant."""

import torch as th

from sb3_cgp import CGP

VARIANTS = {
    "CGP-Online": dict(),
    "CGP-Offline": dict(policy_training="offline"),
    "QGP-Online": dict(policy_loss="qgp"),
    "QGP-Offline": dict(policy_loss="qgp", policy_training="offline"),
    "CEM": dict(policy_loss=None),
    "CGP-Light": dict(cem_start="actor", cem_iterations=1),
}


def make_model(env="Pendulum-v1", policy="MlpPolicy", **kwargs):
    """A model small enough to train in a second."""
    arguments = dict(learning_starts=50, buffer_size=1_000, batch_size=16, cem_samples=8, cem_elites=2, seed=0)
    arguments["policy_kwargs"] = dict(net_arch=[16])
    arguments.update(kwargs)
    return CGP(policy, env, **arguments)


def same_parameters(model, other):
    state, other_state = model.policy.state_dict(), other.policy.state_dict()
    return state.keys() == other_state.keys() and all(th.equal(state[key], other_state[key]) for key in state)
