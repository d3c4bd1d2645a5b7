"""Offline training in a population is that of a CGP alone: of the agents that are due, which go on from their optimizers."""

import numpy as np
import pytest
import torch as th
from populations import Log, adam_state, assert_alike, make, make_env, saved_and_loaded
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import Logger
from trainings import Do

from sb3_cgp import CGP, TrainingCheckpointCallback
from sb3_cgp.core.cem import Selection
from sb3_cgp.population import Population

pytestmark = [
    pytest.mark.usefixtures("short_policy_training"),
    pytest.mark.filterwarnings("ignore:The policy's loss has not reached a plateau"),
    pytest.mark.filterwarnings("ignore:Agent 1 learns nothing"),
]

OBSERVATIONS = np.random.default_rng(0).normal(size=(3, 3))
# The second agent's critics do not learn in the first 40 steps
LATE = [dict(), dict(learning_starts=50), dict()]


class Quarter:
    """Selects 0.25, or the actor's proposal."""

    takes_proposals = True

    def select(self, score, n_states, action_dim, device="cpu", proposals=None):
        actions = th.full((n_states, action_dim), 0.25, device=device) if proposals is None else proposals.squeeze(1)
        return Selection(actions, actions.unsqueeze(1))


def make_offline(agents, env=None, **kwargs):
    return make(agents, env, policy_training="offline", **kwargs)


def copy_weights(population):
    return {name: value.clone() for name, value in population.policy.state_dict().items()}


def has_changed(population, before, index):
    weights, old = population.policy.actors.weights[0], before["actors.weights.0"]
    return not th.equal(weights[:, index], old[:, index])


@pytest.mark.parametrize("kwargs", [dict(), dict(policy_loss="qgp"), dict(cem_start="actor")])
def test_a_population_of_one_is_a_cgp_alone_through_two_offline_trainings(kwargs, float64):
    def train(model):
        for n_steps in (40, 30, 0):
            model.learn(n_steps, reset_num_timesteps=False)
        return model

    population = train(make_offline(1, gamma=0.5, **kwargs))
    alone = train(CGP("MlpPolicy", make_env(1), **population.agents[0], device="cpu"))
    # Two trainings of six rounds of ten steps or more
    assert adam_state(alone, "actor")[0]["step"] >= 120
    np.testing.assert_allclose(population.replay_buffer.actions[:70], alone.replay_buffer.actions[:70], atol=1e-4)
    # Buffers round to single precision
    assert_alike(population[0], alone, rtol=1e-3, atol=1e-4)


def test_an_agent_whose_critics_have_not_learnt_gets_no_actor():
    population = make_offline(LATE, policy_loss="qgp", policy_kwargs=dict(selector=Quarter()))
    before = copy_weights(population)
    population.learn(3 * 40)
    assert population[1]._n_updates == 0
    assert [agent.policy.inference for agent in population] == ["actor", "cem", "actor"]
    assert [has_changed(population, before, index) for index in range(3)] == [True, False, True]
    actions, _ = population.predict(OBSERVATIONS)
    for index, agent in enumerate(population):
        np.testing.assert_allclose(actions[index], agent.predict(OBSERVATIONS[index])[0], atol=1e-6)
    assert (actions[1] == 0.25).all()
    # In rollouts and gradient steps, the trained actors alone propose
    features = population.policy.features(th.as_tensor(OBSERVATIONS, dtype=th.float32).unsqueeze(1))
    selected = population.policy.select_actions(features)
    assert (selected[1] == 0.25).all()
    assert th.equal(selected[[0, 2]], population.policy.actors(features)[0][[0, 2]])
    population.learn(3 * 40, reset_num_timesteps=False)
    assert [agent.policy.inference for agent in population] == ["actor"] * 3


def test_cem_acts_while_the_critics_learn_again():
    seen = []

    class Watcher(BaseCallback):
        def _on_step(self):
            seen.append([agent.policy.inference for agent in self.model])
            return True

    population = make_offline(2).learn(2 * 40)
    population.learn(2 * 5, Watcher(), reset_num_timesteps=False)
    # The callback sees a step before its gradient step
    assert seen == [["actor"] * 2] + [["cem"] * 2] * 4
    assert [agent.policy.inference for agent in population] == ["actor"] * 2


def test_agents_are_trained_again_only_after_their_critics_have_learnt(tmp_path):
    population = make_offline(LATE).learn(3 * 40)
    loaded = saved_and_loaded(population, tmp_path)
    before = copy_weights(population)
    for model in (population, loaded):
        assert [agent.policy.inference for agent in model] == ["actor", "cem", "actor"]
        assert [agent._policy_is_due for agent in model] == [False] * 3
        model.learn(0, reset_num_timesteps=False)
        assert all(th.equal(value, before[name]) for name, value in model.policy.state_dict().items())
        model.learn(3 * 5, reset_num_timesteps=False)
        assert [has_changed(model, before, index) for index in range(3)] == [True, False, True]


def test_loaded_parameters_of_trained_actors_act():
    population = make_offline(LATE).learn(3 * 40)
    fresh = make_offline(LATE)
    assert fresh.policy.inference == "cem"
    fresh.set_parameters(population.get_parameters())
    assert [agent.policy.inference for agent in fresh] == ["actor", "cem", "actor"]
    np.testing.assert_array_equal(fresh.predict(OBSERVATIONS)[0][[0, 2]], population.predict(OBSERVATIONS)[0][[0, 2]])


def test_a_failed_agent_keeps_the_actor_that_it_had_and_acts_by_its_newer_critics(monkeypatch):
    population = make_offline(2).learn(2 * 40)
    before = copy_weights(population)
    train_policy = CGP.train_policy

    def fail_first(agent):
        if agent.seed == 0:
            raise ValueError("The actor loss is nan.")
        return train_policy(agent)

    monkeypatch.setattr(CGP, "train_policy", fail_first)
    with pytest.warns(UserWarning, match="Agent 0 has failed"):
        population.learn(2 * 10, reset_num_timesteps=False)
    assert [agent.policy.inference for agent in population] == ["cem", "actor"]
    assert [has_changed(population, before, index) for index in range(2)] == [False, True]


def test_it_resumes_as_if_it_had_not_stopped(tmp_path):
    def train(folder, *callbacks):
        population = make_offline(LATE[:2], make_vec_env("Pendulum-v1", 2, seed=3)).learn(2 * 40)
        return population.learn(2 * 30, [TrainingCheckpointCallback(20, folder), *callbacks], reset_num_timesteps=False)

    expected = train(tmp_path / "straight")
    with pytest.raises(ZeroDivisionError):
        # Before the second agent's critics learn
        train(tmp_path / "stopped", Do(12, lambda: 1 / 0))
    resumed = Population.resume(tmp_path / "stopped", make_vec_env("Pendulum-v1", 2))
    # The first agent's critics have learnt since its actor was trained
    assert [agent.policy.inference for agent in resumed] == ["cem", "cem"]
    resumed.learn(2 * 30)
    for name, value in expected.policy.state_dict().items():
        assert th.equal(resumed.policy.state_dict()[name], value), name
    assert [agent.policy.inference for agent in resumed] == ["actor"] * 2


def test_a_finished_training_is_resumed_with_its_actors(tmp_path):
    def resume():
        return Population.resume(tmp_path / "state", make_env(2))

    population = make_offline(2, make_env(2)).learn(2 * 40, TrainingCheckpointCallback(20, tmp_path / "state"))
    resumed = resume()
    assert [agent.policy.inference for agent in resumed] == ["actor"] * 2
    resumed.learn(2 * 40)
    for name, value in population.policy.state_dict().items():
        assert th.equal(resumed.policy.state_dict()[name], value), name


def test_an_interrupted_offline_training_goes_on_with_the_next_actor(tmp_path, monkeypatch):
    trained, train_policy = [], CGP.train_policy

    def note(agent):
        trained.append(agent.seed)
        if trained == [0, 1]:
            raise KeyboardInterrupt
        return train_policy(agent)

    monkeypatch.setattr(CGP, "train_policy", note)
    with pytest.raises(KeyboardInterrupt):
        make_offline(3).learn(3 * 40, TrainingCheckpointCallback(20, tmp_path / "state"))
    resumed = Population.resume(tmp_path / "state", make_env(3))
    assert [agent.policy.inference for agent in resumed] == ["actor", "cem", "cem"]
    resumed.learn(3 * 40)
    assert trained == [0, 1, 1, 2]


def test_each_agents_log_has_its_index_and_follows_the_environments_steps():
    population, log = make_offline(2, policy_loss="qgp", diagnostics=True), Log()
    population.set_logger(Logger(None, [log]))
    population.learn(2 * 40)
    for index in range(2):
        steps = [row["step"] for row in log.rows if f"train/actor_loss/agent_{index}" in row]
        assert steps[:3] == [90, 100, 110]
    # Nor diagnostics, which a population does not log
    keys = {key for row in log.rows for key in row}
    assert not keys & {"train/actor_loss", "train/cem_std", "train/saturated_actions", "train/actor_cem_distance"}


def test_the_failure_of_all_actors_is_an_error(monkeypatch):
    def fail(agent):
        raise ValueError("The actor loss is nan.")

    monkeypatch.setattr(CGP, "train_policy", fail)
    with (
        pytest.warns(UserWarning, match="Agent . has failed") as caught,
        pytest.raises(ValueError, match=r"All agents have failed\. Agent 1: The actor loss is nan"),
    ):
        make_offline(2).learn(2 * 40)
    first, second = (str(warning.message) for warning in caught if "has failed" in str(warning.message))
    assert first.endswith("The other agents go on.")
    assert second.endswith("nan.")
