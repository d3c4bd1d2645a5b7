"""The bias of critics' values, as it is measured: against closed forms."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from counting import GAMMA, SMALL, Counter
from stable_baselines3 import TD3
from torch import nn

from benchmark.values import bias, episodes
from sb3_cgp import CGP


class KnownValues(nn.Module):
    """A Q-network whose value is an offset plus the state, and 1000 times the action."""

    def __init__(self, offset):
        super().__init__()
        self.offset = offset

    def forward(self, rows):
        return self.offset + rows[:, :1] + 1000 * rows[:, 1:]


def known_model(env):
    """Return a CGP whose critics are 7 and 5 plus the state, for the action 0."""
    model = CGP("MlpPolicy", env, **SMALL)
    for index, offset in enumerate((7.0, 5.0)):
        model.critic.q_networks[index] = KnownValues(offset)
    return model


def act(observations):
    return np.zeros((len(observations), 1), np.float32)


def played(model, ends_after, time_limit):
    env = gym.wrappers.TimeLimit(Counter(ends_after), time_limit)
    return bias.measure(model, episodes.play(act, [env], seed=0))


def test_bias_of_a_terminating_episode_is_exact():
    measured = played(known_model(Counter()), ends_after=4, time_limit=100)
    # With k rewards of 1 to go, the return is (1 - γ^k) / (1 - γ)
    returns = [(1 - GAMMA**to_go) / (1 - GAMMA) for to_go in (4, 3, 2, 1)]
    assert measured["discounted_return"] == pytest.approx(np.mean(returns))
    assert (measured["q1"], measured["q_min"]) == pytest.approx((7 + 1.5, 5 + 1.5))
    assert (measured["return"], measured["length"], measured["n_states"], measured["error_bound"]) == (4.0, 4.0, 4, 0.0)


def test_bias_of_a_truncated_episode_is_within_its_bound():
    measured = played(known_model(Counter()), ends_after=None, time_limit=600)
    # γ^459 is the first power below 0.01: the first 142 states have so many rewards to go
    assert GAMMA**458 > 0.01 > GAMMA**459
    assert measured["n_states"] == 142
    assert measured["q1"] == pytest.approx(7 + np.mean(range(142)))
    # Rewards of 1 for ever are worth 1 / (1 - γ). As no reward is larger, the bound is the error.
    assert 1 / (1 - GAMMA) - measured["discounted_return"] == pytest.approx(measured["error_bound"])
    assert measured["error_bound"] < 0.01 / (1 - GAMMA)


def test_too_short_a_truncated_episode_counts_no_state():
    measured = played(known_model(Counter()), ends_after=None, time_limit=458)
    assert (measured["n_states"], measured["q1"], measured["discounted_return"]) == (0, None, None)
    assert measured["return"] == 458.0


def test_a_termination_at_the_time_limit_is_a_termination():
    assert played(known_model(Counter()), ends_after=5, time_limit=5)["n_states"] == 5


def test_states_of_several_episodes_count_alike():
    envs = [gym.wrappers.TimeLimit(Counter(ends_after), 600) for ends_after in (2, 8, None)]
    batches = []

    def recording_act(observations):
        batches.append(observations[:, 0].tolist())
        return act(observations)

    found = episodes.play(recording_act, envs, seed=0)
    assert [(len(each.rewards), each.is_terminated) for each in found] == [(2, True), (8, True), (600, False)]
    # All environments at once, while they last
    assert (batches[1], batches[5], batches[9]) == ([1.0] * 3, [5.0] * 2, [9.0])
    measured = bias.measure(known_model(Counter()), found)
    states = [*range(2), *range(8), *range(142)]
    assert measured["q1"] == pytest.approx(7 + np.mean(states))
    assert measured["length"] == pytest.approx((2 + 8 + 600) / 3)


def test_episodes_begin_in_the_same_states_each_time():
    envs = [gym.make("Pendulum-v1") for _ in range(2)]
    first, again = (episodes.play(act, envs, seed=5) for _ in range(2))
    starts = [each.observations[0].tolist() for each in (*first, *again)]
    assert starts[:2] == starts[2:]
    assert starts[0] != starts[1]


def test_returns_to_go():
    assert episodes.returns_to_go([1.0, 0.0, 4.0], 0.5).tolist() == [2.0, 2.0, 4.0]


@pytest.mark.parametrize("algorithm", [CGP, TD3])
def test_values_are_those_of_scaled_actions(algorithm):
    model = algorithm("MlpPolicy", "Pendulum-v1", **SMALL)
    observations = np.random.default_rng(0).normal(size=(3, 3)).astype(np.float32)
    found = bias.critic_values(model, observations, np.full((3, 1), 1.0, np.float32))
    # Pendulum's torque of 1 is half of its maximum
    rows = th.cat([th.as_tensor(observations), th.full((3, 1), 0.5)], dim=1)
    expected = th.cat([q_network(rows) for q_network in model.critic.q_networks], dim=1)
    assert found == pytest.approx(expected.detach().numpy(), abs=1e-6)


@pytest.mark.parametrize("algorithm", [CGP, TD3])
def test_measuring_does_not_disturb_the_training(algorithm, monkeypatch):
    monkeypatch.setattr(episodes, "TAIL", 0.5)
    callback = bias.BiasCallback("Pendulum-v1", interval=15, n_episodes=2, episode_steps=100)
    parameters = []
    for measuring in (callback, None):
        model = algorithm("MlpPolicy", "Pendulum-v1", **SMALL).learn(60, measuring)
        parameters.append(nn.utils.parameters_to_vector(model.policy.parameters()))
    assert parameters[0].equal(parameters[1])
    assert [point["steps"] for point in callback.points] == [30, 45, 60]
    for point in callback.points:
        assert set(point) == {"steps", *(("actor", "cem") if algorithm is CGP else ("actor",))}
        # 100 steps, of which 69 halve a reward
        assert point["actor"]["n_states"] == 2 * 32
    # Different policies act
    if algorithm is CGP:
        assert callback.points[-1]["actor"]["return"] != callback.points[-1]["cem"]["return"]
