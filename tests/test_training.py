"""The gradient step of Algorithm 2: against SB3's TD3, against hand computations, and on its stored transitions."""

import gymnasium as gym
import numpy as np
import oracles
import pytest
import torch as th
from stable_baselines3 import TD3
from stable_baselines3.common.envs import IdentityEnvBox
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import DummyVecEnv
from torch.nn import functional as F

from sb3_cgp import CGP, CGPPolicy, Selection
from sb3_cgp.core.losses import POLICY_LOSSES
from sb3_cgp.diagnostics import policy_diagnostics


class TargetActorPolicy(CGPPolicy):
    """A policy in which the target actor stands in for CEM, which makes CGP's Q-learning TD3's."""

    def select_actions(self, observation, critic):
        with th.no_grad():
            actions = self.actor_target(observation)
        return Selection(actions, actions.unsqueeze(1))


def parameters_of(model):
    return dict(model.policy.state_dict().items())


@pytest.mark.parametrize("n_critics", [1, 2, 3])
def test_is_td3_where_the_target_actor_stands_in_for_cem(n_critics):
    arguments = dict(
        learning_starts=200,
        buffer_size=1_000,
        batch_size=32,
        learning_rate=1e-3,
        policy_delay=2,
        seed=3,
        policy_kwargs=dict(net_arch=[32, 32], n_critics=n_critics),
    )
    td3 = TD3("MlpPolicy", "Pendulum-v1", **arguments)
    cgp = CGP(TargetActorPolicy, "Pendulum-v1", policy_loss="qgp", target_update_interval=2, **arguments)
    for name, parameter in parameters_of(td3).items():
        assert th.equal(parameters_of(cgp)[name], parameter), name

    # Random steps only: both buffers hold the same transitions
    for model in (td3, cgp):
        model.learn(200)
        set_random_seed(0)
        model.train(gradient_steps=150, batch_size=32)

    for name, parameter in parameters_of(td3).items():
        th.testing.assert_close(parameters_of(cgp)[name], parameter, rtol=1e-4, atol=1e-6, msg=name)


def filled_model(**kwargs):
    """A small model whose buffer holds random steps of Pendulum, and a logger that prints nothing."""
    arguments = dict(learning_starts=300, buffer_size=500, batch_size=16, seed=0, policy_kwargs=dict(net_arch=[16]))
    arguments.update(kwargs)
    model = CGP("MlpPolicy", "Pendulum-v1", **arguments)
    model.learn(300)
    return model


def q_value(model, network, observation, action, index=0):
    """One Q-value by the oracle's matrix products."""
    layers = [layer for layer in network.q_networks[index] if hasattr(layer, "weight")]
    inputs = th.cat([observation, action])
    return oracles.mlp([layer.weight for layer in layers], [layer.bias for layer in layers], inputs)


def losses_of_one_step(model, batch_size=16):
    """The losses of one gradient step in which no network is changed, and the step's minibatch."""
    losses, batches = {}, []
    sample = model.replay_buffer.sample
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(model, "_descend", lambda name, loss: losses.update({name: loss.item()}))
        patch.setattr(
            model.replay_buffer, "sample", lambda *args, **kwargs: batches.append(sample(*args, **kwargs)) or batches[0]
        )
        model.train(gradient_steps=1, batch_size=batch_size)
    return losses, batches[0]


@pytest.mark.parametrize("n_critics", [1, 2, 3])
@pytest.mark.parametrize("n_steps", [1, 3])
def test_critic_loss_by_hand(n_critics, n_steps):
    policy_kwargs = dict(net_arch=[16], n_critics=n_critics, selector=FixedSelector(0.4))
    arguments = dict(gamma=0.9, target_policy_noise=0.0, tau=1.0, target_update_interval=1)
    model = filled_model(n_steps=n_steps, policy_kwargs=policy_kwargs, **arguments)
    model.replay_buffer.dones[::7] = 1
    model.replay_buffer.timeouts[:] = 0
    model.train(gradient_steps=2, batch_size=16)
    losses, batch = losses_of_one_step(model)
    assert 0 < batch.dones.sum() < 16
    expected = 0.0
    for row in range(16):
        observation, action, next_observation = batch.observations[row], batch.actions[row], batch.next_observations[row]
        discount = 0.9 if n_steps == 1 else batch.discounts[row].item()
        next_values = [q_value(model, model.critic_target, next_observation, th.tensor([0.4]), j) for j in range(n_critics)]
        target = oracles.bootstrap_target(batch.rewards[row].item(), bool(batch.dones[row]), discount, next_values)
        for j in range(n_critics):
            expected += (q_value(model, model.critic, observation, action, j).item() - target) ** 2 / 16
    assert losses["critic"] == pytest.approx(float(expected), rel=1e-4)


@pytest.mark.parametrize("selected", [0.0, 0.95])
@pytest.mark.parametrize("noise_std", [0.0, 0.2])
def test_target_noise_is_gaussian_and_clipped(selected, noise_std):
    policy_kwargs = dict(net_arch=[8], selector=FixedSelector(selected))
    model = filled_model(target_policy_noise=noise_std, policy_kwargs=policy_kwargs)
    asked = []
    model.critic_target.q_networks[0].register_forward_pre_hook(lambda module, inputs: asked.append(inputs[0][:, 3:]))
    model.train(gradient_steps=1, batch_size=100_000)
    (actions,) = asked
    noise = actions - selected
    if noise_std == 0.0:
        assert noise.abs().max() == 0.0
    elif selected == 0.0:
        assert noise.abs().max().item() == pytest.approx(0.5)
        # P(|N(0, 0.2)| > 0.5) = P(|N(0, 1)| > 2.5) = 0.0124
        assert (noise.abs() == 0.5).float().mean().item() == pytest.approx(0.0124, abs=0.002)
        assert noise.std().item() == pytest.approx(0.198, abs=0.004)
    else:
        assert actions.max().item() == 1.0


def test_averages_follow_every_second_gradient_step():
    model = filled_model(tau=0.1, target_update_interval=2)
    pairs = [(model.critic, model.critic_target), (model.actor, model.actor_target)]
    for step in range(1, 7):
        old = [[parameter.clone() for parameter in average.parameters()] for _, average in pairs]
        model.train(gradient_steps=1, batch_size=16)
        for (network, average), before in zip(pairs, old, strict=True):
            for new, parameter, previous in zip(network.parameters(), average.parameters(), before, strict=True):
                expected = oracles.polyak(previous, new, 0.1) if step % 2 == 0 else previous
                th.testing.assert_close(parameter, expected)


@pytest.mark.parametrize("policy_delay", [1, 3])
def test_policy_delay_counts_gradient_steps(policy_delay):
    model = filled_model(policy_delay=policy_delay)
    for step in range(1, 8):
        old = [parameter.clone() for parameter in model.actor.parameters()]
        model.train(gradient_steps=1, batch_size=16)
        moved = any(not th.equal(a, b) for a, b in zip(old, model.actor.parameters(), strict=True))
        assert moved == (step % policy_delay == 0)


class FixedSelector:
    """Selects always the same action."""

    def __init__(self, action):
        self.action = action

    def select(self, score, n_states, action_dim, device="cpu"):
        actions = th.full((n_states, action_dim), self.action)
        return Selection(actions, actions.unsqueeze(1))


def test_cgp_loss_pulls_the_actor_to_the_selector_whatever_the_critic():
    model = filled_model(actor_learning_rate=1e-2, policy_kwargs=dict(net_arch=[16], selector=FixedSelector(-0.3)))
    model.train(gradient_steps=500, batch_size=16)
    observations = model.replay_buffer.sample(64).observations
    assert model.actor(observations).flatten().tolist() == pytest.approx([-0.3] * 64, abs=0.05)


def test_actor_losses_are_those_of_the_paper():
    for policy_loss in ("cgp", "qgp"):
        model = filled_model(policy_loss=policy_loss, policy_kwargs=dict(net_arch=[16], selector=FixedSelector(0.7)))
        observations = model.replay_buffer.sample(16).observations
        actions = model.actor(observations).detach()
        if policy_loss == "cgp":
            expected = (actions - 0.7).square().mean().item()
        else:
            values = [q_value(model, model.critic, s, a).item() for s, a in zip(observations, actions, strict=True)]
            expected = -np.mean(values)
        before = [parameter.clone() for parameter in model.critic.parameters()]
        assert POLICY_LOSSES[policy_loss](model.policy, observations).item() == pytest.approx(expected, rel=1e-4)
        losses, batch = losses_of_one_step(model)
        assert losses["actor"] == pytest.approx(POLICY_LOSSES[policy_loss](model.policy, batch.observations).item())
        assert all(th.equal(a, b) for a, b in zip(before, model.critic.parameters(), strict=True))


class Endless(gym.Env):
    """One state, reward 1 at every step; ends after `length` steps, for good or by running out of time."""

    observation_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, length, terminates):
        self.length, self.terminates = length, terminates

    def reset(self, *, seed=None, options=None):
        self.steps = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.steps += 1
        ends = self.steps >= self.length
        return np.zeros(1, np.float32), 1.0, ends and self.terminates, ends and not self.terminates, {}


@pytest.mark.parametrize("terminates", [True, False])
def test_timeouts_bootstrap_and_terminations_do_not(terminates):
    env = Endless(length=1, terminates=terminates)
    model = CGP("MlpPolicy", env, learning_starts=50, buffer_size=100, gamma=0.5, tau=1.0, target_update_interval=1,
                learning_rate=1e-2, batch_size=32, seed=0, policy_kwargs=dict(net_arch=[16]))  # fmt: skip
    model.learn(50)
    # Every episode lasts one step, so that every stored transition ends one
    assert model.replay_buffer.dones[:50].all()
    assert model.replay_buffer.timeouts[:50].all() == (not terminates)
    assert (model.replay_buffer.sample(32).dones.unique().tolist() == [1.0]) == terminates

    model.train(gradient_steps=500, batch_size=32)
    # Q = 1 + 0.5 Q where the episode runs out of time, Q = 1 where it terminates
    value = model.critic.q1_forward(th.zeros(1, 1), th.zeros(1, 1)).item()
    assert value == pytest.approx(1.0 if terminates else 2.0, abs=0.1)


@pytest.mark.parametrize("what", ["reward", "observation"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_nan_from_the_environment_stops_training_by_name_and_step(what, value):
    class Faulty(Endless):
        def step(self, action):
            observation, reward, terminated, truncated, info = super().step(action)
            if self.steps == 30:
                if what == "reward":
                    reward = value
                else:
                    observation = observation + np.float32(value)
            return observation, reward, terminated, truncated, info

    model = CGP("MlpPolicy", Faulty(100, True), learning_starts=10, batch_size=8, policy_kwargs=dict(net_arch=[8]))
    with pytest.raises(ValueError, match=f"{what} at environment step 30"):
        model.learn(100)
    assert model.replay_buffer.size() == 29
    assert all(parameter.isfinite().all() for parameter in model.policy.parameters())


def test_a_nan_in_the_first_observation_or_in_a_final_one_stops_training():
    class Blind(Endless):
        def reset(self, **kwargs):
            super().reset(**kwargs)
            return np.full(1, np.nan, np.float32), {}

    class BlindAtTheEnd(Endless):
        def step(self, action):
            observation, reward, terminated, truncated, info = super().step(action)
            return observation + np.float32(np.nan if terminated else 0.0), reward, terminated, truncated, info

    with pytest.raises(ValueError, match="observation at environment step 0"):
        CGP("MlpPolicy", Blind(5, True), buffer_size=10).learn(10)
    with pytest.raises(ValueError, match="terminal observation at environment step 5"):
        CGP("MlpPolicy", BlindAtTheEnd(5, True), buffer_size=10).learn(10)


@pytest.mark.parametrize("where", ["observations", "weights"])
def test_nan_is_seen_in_batches_and_networks_of_any_size(where):
    # Large enough for the products that are not PyTorch's usual ones, which might take NaN for zero
    model = filled_model(policy_kwargs=dict(net_arch=[256, 256]), cem_samples=8, cem_elites=2)
    if where == "observations":
        model.replay_buffer.observations[:] = np.nan
    else:
        with th.no_grad():
            model.critic.q_networks[0][2].weight[3, 5] = th.nan
    with pytest.raises(ValueError, match="The critic loss is nan at gradient step 1"):
        model.train(gradient_steps=1, batch_size=128)


@pytest.mark.parametrize("network", ["critic", "actor"])
def test_a_nan_loss_stops_training_before_the_network_is_ruined(network):
    model = filled_model(policy_loss="qgp")
    if network == "critic":
        model.replay_buffer.rewards[:] = np.inf
    else:
        model.policy.select_actions = lambda observation, critic: Selection(
            th.zeros(len(observation), 1), th.zeros(len(observation), 1, 1)
        )
        model.critic.q1_forward = lambda observations, actions: actions * th.nan
    before = {name: parameter.clone() for name, parameter in getattr(model, network).state_dict().items()}
    with pytest.raises(ValueError, match=f"The {network} loss is .* at gradient step 1, environment step 300"):
        model.train(gradient_steps=1, batch_size=16)
    for name, parameter in getattr(model, network).state_dict().items():
        assert th.equal(parameter, before[name])


def logged(model):
    """What a model's training logs, as numbers."""
    model.set_logger(Logger(folder=None, output_formats=[]))
    model.train(gradient_steps=200, batch_size=16)
    return dict(model.logger.name_to_value)


@pytest.mark.parametrize(
    ("variant", "trains_actor"),
    [
        (dict(), True),
        (dict(policy_loss="qgp"), True),
        (dict(policy_training="offline"), False),
        (dict(policy_loss=None), False),
    ],
    ids=str,
)
def test_training_logs_what_the_documentation_explains(variant, trains_actor):
    values = logged(filled_model(**variant))
    of_the_actor = {"train/actor_loss", "train/actor_cem_distance", "train/cem_q_advantage"}
    always = {
        "train/n_updates",
        "train/updates_per_step",
        "train/learning_rate",
        "train/actor_learning_rate",
        "train/critic_loss",
        "train/q_value",
        "train/cem_std",
        "train/saturated_actions",
    }
    assert set(values) == (always | of_the_actor if trains_actor else always)
    assert all(np.isfinite(value) for value in values.values())


def test_diagnostics_measure_what_they_say():
    model = filled_model(policy_kwargs=dict(net_arch=[16], selector=FixedSelector(0.995)))
    observations = model.replay_buffer.sample(16).observations
    values = policy_diagnostics(model.policy, observations, has_actor=True)
    with th.no_grad():
        actions = model.actor(observations)
        q_cem = model.critic.q1_forward(observations, th.full((16, 1), 0.995))
        q_actor = model.critic.q1_forward(observations, actions)
    assert values["train/saturated_actions"] == 1.0
    assert values["train/cem_std"] == 0.0
    assert values["train/actor_cem_distance"] == pytest.approx(F.mse_loss(actions, th.full((16, 1), 0.995)).item() ** 0.5)
    assert values["train/cem_q_advantage"] == pytest.approx((q_cem - q_actor).mean().item(), abs=1e-6)


@pytest.mark.parametrize(
    ("n_envs", "train_freq", "gradient_steps", "expected"), [(1, 1, 1, 1.0), (4, 1, 1, 0.25), (4, 2, -1, 1.0)]
)
def test_gradient_steps_per_environment_step_are_logged(n_envs, train_freq, gradient_steps, expected):
    env = DummyVecEnv([lambda: IdentityEnvBox(eps=0.5) for _ in range(n_envs)])
    model = CGP("MlpPolicy", env, learning_starts=40, train_freq=train_freq, gradient_steps=gradient_steps, batch_size=8)
    model.set_logger(Logger(folder=None, output_formats=[]))
    ratios = []
    record = model.logger.record
    model.logger.record = lambda key, value, *args, **kwargs: (
        ratios.append(value) if key == "train/updates_per_step" else None,
        record(key, value, *args, **kwargs),
    )
    model.learn(80, log_interval=None)
    assert ratios
    assert ratios == pytest.approx([expected] * len(ratios))
