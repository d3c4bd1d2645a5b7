"""Variants of CGP in the experiment on bias: their targets and scores, against slow oracles."""

import gymnasium as gym
import numpy as np
import oracles
import pytest
import torch as th
from counting import GAMMA, SMALL, Counter
from stable_baselines3 import TD3
from torch import nn

from benchmark.values import methods, variants
from sb3_cgp import CGP


def filled_model(algorithm, **kwargs):
    """Return a model with a filled replay buffer, on a task with terminations."""
    env = gym.wrappers.TimeLimit(Counter(ends_after=5), 50)
    return algorithm("MlpPolicy", env, **(SMALL | kwargs)).learn(60)


def value(q_network, features, action):
    """Return the value of one state and action, by a slow oracle."""
    layers = [layer for layer in q_network if isinstance(layer, nn.Linear)]
    weights, biases = ([getattr(layer, name).detach() for layer in layers] for name in ("weight", "bias"))
    return float(oracles.mlp(weights, biases, th.cat([features.flatten(), action.detach().flatten()])))


def targets_of(model, monkeypatch):
    """Return the critics' targets in one gradient step, with the batch and the bootstrap actions."""
    batches, actions, targets = [], [], []
    sample = model.replay_buffer.sample

    def recording_sample(*args, **kwargs):
        batches.append(sample(*args, **kwargs))
        return batches[-1]

    def recording_mse(values, target):
        targets.append(target)
        return (values - target).square().mean()

    with monkeypatch.context() as patch:
        patch.setattr(model.replay_buffer, "sample", recording_sample)
        patch.setattr("sb3_cgp.core.cgp.F.mse_loss", recording_mse)
        hook = model.critic_target.register_forward_pre_hook(lambda _, inputs: actions.append(inputs[1]))
        model.train(gradient_steps=1, batch_size=16)
        hook.remove()
    return batches[0], actions[0], targets[0].flatten().tolist()


def transitions(batch, actions):
    return zip(batch.rewards, batch.dones, batch.next_observations, actions, strict=True)


def test_target_is_floored_at_the_averaged_actor(monkeypatch):
    # The update of the averages would come before the oracle
    model = filled_model(variants.FlooredCGP, target_update_interval=1000)
    # Critics that prefer different actions, so that CEM's action by the first one is no good choice for the minimum
    for q_network, sign in zip(model.critic_target.q_networks, (1, -1), strict=True):
        q_network[-1].weight.data.mul_(30 * sign)
    batch, actions, targets = targets_of(model, monkeypatch)
    raised = 0
    for target, (reward, done, state, action) in zip(targets, transitions(batch, actions), strict=True):
        averaged = model.actor_target(state[None])[0]
        of_action, of_actor = (
            min(value(q_network, state, each) for q_network in model.critic_target.q_networks) for each in (action, averaged)
        )
        raised += of_actor > of_action and not done
        expected = oracles.bootstrap_target(float(reward), bool(done), GAMMA, [max(of_action, of_actor)])
        assert target == pytest.approx(expected, abs=1e-4)
    assert 0 < raised < len(targets)


def test_target_is_clamped_to_the_range_of_earlier_targets(monkeypatch):
    monkeypatch.setattr(variants.ClampedCGP, "RANGE_INTERVAL", 3)
    model = filled_model(variants.ClampedCGP, target_update_interval=1000, learning_starts=59)
    for q_network in model.critic_target.q_networks:
        q_network[-1].weight.data.mul_(30)
    low, high, seen, clamped = 0.0, 0.0, list(model.seen_range), 0
    # `learn` has taken one step
    for step in range(2, 9):
        batch, actions, targets = targets_of(model, monkeypatch)
        for target, (reward, done, state, action) in zip(targets, transitions(batch, actions), strict=True):
            least = min(value(q_network, state, action) for q_network in model.critic_target.q_networks)
            clamped += step > 3 and not low <= least <= high
            expected = oracles.bootstrap_target(float(reward), bool(done), GAMMA, [min(max(least, low), high)])
            assert target == pytest.approx(expected, abs=1e-4)
        seen += targets
        if step % 3 == 0:
            low, high = min(seen), max(seen)
    assert model.clamp_range == pytest.approx((low, high))
    assert high > 0.0
    assert clamped > 0


@pytest.mark.parametrize("name", ["critic", "critic_target"])
@pytest.mark.parametrize(("cem_dtype", "tolerance"), [("float32", 1e-4), ("bfloat16", 0.05)])
def test_score_is_the_minimum_of_both_critics(name, cem_dtype, tolerance):
    model = CGP(variants.MinScorePolicy, "Pendulum-v1", cem_dtype=cem_dtype, **SMALL)
    critic = getattr(model, name)
    th.manual_seed(1)
    features, actions = th.randn(9, 3), th.rand(9, 5, 1) * 2 - 1
    with th.no_grad():
        # Each of them is the smaller one for some states
        for q_network in critic.q_networks:
            q_network[-1].weight.mul_(3)
            q_network[-1].bias.sub_(q_network(th.cat([features, actions[:, 0]], dim=1)).mean())
        scores = model.policy.make_score(critic.q_networks[0], features)(actions)
    chosen = set()
    for state in range(9):
        for sample in range(5):
            values = [value(q_network, features[state], actions[state, sample]) for q_network in critic.q_networks]
            assert float(scores[state, sample]) == pytest.approx(min(values), abs=tolerance)
            chosen.add(int(np.argmin(values)))
    assert chosen == {0, 1}


def test_score_is_nan_where_one_critic_is():
    model = CGP(variants.MinScorePolicy, "Pendulum-v1", **SMALL)
    model.critic.q_networks[1][-1].bias.data.fill_(th.nan)
    assert model.policy.make_score(model.critic.q_networks[0], th.zeros(2, 3))(th.zeros(2, 4, 1)).isnan().all()


@pytest.mark.parametrize("name", methods.METHODS)
def test_methods_are_what_their_names_say(name):
    model = methods.make_model(name, "Pendulum-v1", units=8, seed=0, device=th.device("cpu"), learning_starts=10)
    model.learn(20)
    assert model._n_updates == 10
    assert model.critic.q_networks[0][0].out_features == 8
    if name == "TD3":
        assert type(model) is TD3
        assert model.action_noise._sigma.tolist() == [0.1]
        return
    assert model.inference is None
    expected = {"CGP-Light": ("actor", 1, 16)}.get(name, ("prior", int(name.split("-")[1]) if name != "CGP-Light" else 1, 64))
    assert (model.cem_start, model.cem_iterations, model.cem_samples) == expected
    assert model.cem_result == ("mean" if name.endswith("mean") else "best")
