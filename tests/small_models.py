"""CGP models that train in a second, one of every variant."""

import pytest
import torch as th

from sb3_cgp import CEM, CGP, MlpPolicy

VARIANTS = {
    "CGP-Online": dict(),
    "CGP-Offline": dict(policy_training="offline"),
    "QGP-Online": dict(policy_loss="qgp"),
    "QGP-Offline": dict(policy_loss="qgp", policy_training="offline"),
    "CEM": dict(policy_loss=None),
    "CGP-Light": dict(cem_start="actor", cem_iterations=1),
}


class WithSelector(MlpPolicy):
    """A policy class of a user's, with a selector of its own."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **(dict(selector=CEM(1, 8, 4)) | kwargs))


def make_model(env="Pendulum-v1", policy="MlpPolicy", **kwargs):
    """A model small enough to train in a second."""
    arguments = dict(learning_starts=50, buffer_size=1_000, batch_size=16, cem_samples=8, cem_elites=2, seed=0)
    arguments["policy_kwargs"] = dict(net_arch=[16])
    arguments.update(kwargs)
    return CGP(policy, env, **arguments)


def step_without_learning(model):
    """
    Take an environment step and a gradient step in which no networks but the averaged ones change.

    :return: the observations for which actions are selected, in this order: in acting, for bootstrapping, in the policy's loss
    """
    acting, batches, sample = th.as_tensor(model._last_obs.copy()), [], model.replay_buffer.sample
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            model.replay_buffer, "sample", lambda *args, **kwargs: batches.append(sample(*args, **kwargs)) or batches[0]
        )
        patch.setattr(model, "_descend", lambda name, loss: None)
        model.learn(1, reset_num_timesteps=False)
    (batch,) = batches
    return acting, batch.next_observations, batch.observations


def same_parameters(model, other):
    state, other_state = model.policy.state_dict(), other.policy.state_dict()
    return state.keys() == other_state.keys() and all(th.equal(state[key], other_state[key]) for key in state)
