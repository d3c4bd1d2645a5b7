"""An agent of a population that fails: it is frozen and named, and the others do not notice."""

import math

import pytest
import torch as th
from populations import adam_state, make, make_env
from stable_baselines3.common.callbacks import BaseCallback

from sb3_cgp import CGP
from sb3_cgp.population import Population


def test_an_agent_that_diverges_is_frozen_and_named_and_the_others_do_not_notice():
    healthy = make([dict(), dict(), dict()]).learn(3 * 80)
    with pytest.warns(
        UserWarning, match=r"Agent 1 has failed. The (critic|actor) loss was NaN or infinite at gradient step \d"
    ):
        population = make([dict(), dict(learning_rate=1e30), dict()]).learn(3 * 80)
    assert population.failed.keys() == {1}
    assert healthy.failed == {}
    assert population.logger.name_to_value.get("train/failed_agents", 1) == 1
    for index in (0, 2):
        expected = healthy[index].policy.state_dict()
        assert all(th.equal(population[index].policy.state_dict()[name], value) for name, value in expected.items())
    assert list(population._agent_updates)[::2] == [60, 60]
    assert population._agent_updates[1] < 10


@pytest.mark.parametrize("policy_loss", ["cgp", "qgp"])
def test_a_failed_agent_stays_as_it_was_before_the_step(policy_loss):
    class Poison(BaseCallback):
        def _on_step(self):
            if self.n_calls == 50:
                self.model.replay_buffer.rewards[:, 2] = math.nan
                self.before = self.model[2]
            return True

    population, poison = make(3, policy_loss=policy_loss), Poison()
    with pytest.warns(UserWarning, match="Agent 2 has failed. The critic loss was NaN or infinite at gradient step 30"):
        population.learn(3 * 70, callback=poison)
    assert poison.before._n_updates == 29
    assert population[2]._n_updates == 30
    expected = poison.before.policy.state_dict()
    assert all(th.equal(population[2].policy.state_dict()[name], value) for name, value in expected.items())
    for own, before in zip(adam_state(population[2], "critic"), adam_state(poison.before, "critic"), strict=True):
        assert all(th.equal(own[name], value) for name, value in before.items())
    assert not th.equal(population[1].critic.q_networks[0][0].weight, poison.before.critic.q_networks[0][0].weight)


def test_a_population_whose_agents_have_all_failed_stops():
    with (
        pytest.warns(UserWarning, match="has failed"),
        pytest.raises(ValueError, match=r"All agents have failed\. Agent 1: The critic loss"),
    ):
        make(2, learning_rate=1e30).learn(2 * 80)


def test_an_agent_that_fails_in_offline_training_does_not_stop_the_others(monkeypatch):
    def train_policy(agent):
        if agent.seed == 0:
            raise ValueError("The actor loss is nan.")
        agent.actor.mu[0].weight.data.fill_(3.0)
        return agent

    monkeypatch.setattr(CGP, "train_policy", train_policy)
    with pytest.warns(UserWarning, match="Agent 0 has failed. The actor loss is nan. The other agents go on."):
        population = make(2, policy_training="offline").learn(2 * 25)
    assert population.failed == {0: "The actor loss is nan."}
    assert [agent.policy.inference for agent in population] == ["cem", "actor"]
    assert (population[1].actor.mu[0].weight == 3.0).all()


def test_failures_outlive_saving(tmp_path):
    with pytest.warns(UserWarning, match="Agent 0 has failed"):
        population = make([dict(learning_rate=1e30), dict()]).learn(2 * 60)
    population.save(tmp_path / "population")
    loaded = Population.load(tmp_path / "population", env=make_env(2))
    assert loaded.failed == population.failed
    before = loaded[0].policy.state_dict()
    loaded.learn(2 * 60, reset_num_timesteps=False)
    assert all(th.equal(loaded[0].policy.state_dict()[name], value) for name, value in before.items())


def test_a_state_is_saved_with_the_failures_that_the_host_has_not_read_yet():
    """On a GPU they are read every hundred gradient steps."""
    population = make(3).learn(3 * 30)
    population.policy.failed_at[0, 1] = 5
    with pytest.warns(UserWarning, match="Agent 1 has failed. The critic loss was NaN or infinite at gradient step 5"):
        population._before_saving_state()
    assert population.failed.keys() == {1}
    assert population._agent_updates[1] == 5


@pytest.mark.filterwarnings("ignore:Agent 1 has failed")
def test_the_log_has_the_means_over_the_agents_that_have_not_failed():
    population = make([dict(), dict(learning_rate=1e30), dict(learning_starts=1_000)]).learn(3 * 80)
    population.train(1, 8)
    losses = population._unlogged["critic_loss"].tolist()
    assert not math.isfinite(losses[1])
    population._record_losses()
    assert population.logger.name_to_value["train/critic_loss"] == losses[0]
