"""A population's agents as ordinary models: they predict, are saved and exported, and train on."""

import functools
import io
import warnings

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from populations import AGENTS, Pushed, PushedOnAxes, assert_alike, make, make_env
from stable_baselines3.common.noise import NormalActionNoise

from sb3_cgp import CGP
from sb3_cgp.population import make_population_env


def test_an_agent_predicts_as_it_does_in_the_population():
    population = make(3).learn(3 * 60)
    observations = np.random.default_rng(0).normal(size=(3, 3))
    actions, _ = population.predict(observations)
    for index, agent in enumerate(population):
        np.testing.assert_allclose(agent.predict(observations[index])[0], actions[index], atol=1e-6)


def test_an_agent_saves_loads_and_exports(tmp_path):
    pytest.importorskip("onnx")
    pytest.importorskip("safetensors")
    population = make(AGENTS).learn(3 * 60)
    observation = np.ones(3)
    for index in (0, 1):
        agent = population[index]
        expected, _ = agent.predict(observation)
        agent.save(tmp_path / "agent")
        loaded = CGP.load(tmp_path / "agent")
        np.testing.assert_array_equal(loaded.predict(observation)[0], expected)
        assert (loaded.gamma, loaded.tau, loaded._n_updates) == (agent.gamma, agent.tau, (40, 38)[index])
        assert_alike(loaded, agent, rtol=0, atol=0)
        agent.export(tmp_path / f"export{index}")
        exported, _ = CGP.load_weights(tmp_path / f"export{index}").predict(observation)
        np.testing.assert_allclose(exported, expected, atol=1e-5)


def test_agents_act_learn_and_export_with_actions_of_several_axes(tmp_path):
    pytest.importorskip("onnx")
    pytest.importorskip("safetensors")
    # Agent 1 alone has noise: zero noise of the same shape stands for the other's
    agents = [dict(), dict(action_noise=NormalActionNoise(np.zeros((2, 2)), 0.1 * np.ones((2, 2))))]
    env = make_population_env(PushedOnAxes, 2, n_processes=2, start_method="fork")
    try:
        population = make(agents, env).learn(2 * 40)
    finally:
        env.close()
    observations = np.random.default_rng(0).normal(size=(2, 3, 2))
    actions, _ = population.predict(observations)
    assert actions.shape == (2, 2, 2)
    for index in range(2):
        agent = population.agent(index, env=PushedOnAxes())
        np.testing.assert_allclose(agent.predict(observations[index])[0], actions[index], atol=1e-6)
        agent.learn(10, reset_num_timesteps=False)
        agent.export(tmp_path / f"{index}")
        exported, _ = CGP.load_weights(tmp_path / f"{index}").predict(observations[index])
        np.testing.assert_allclose(exported, agent.predict(observations[index])[0], atol=1e-5)


def test_a_copy_of_an_agent_whose_actor_is_not_due_yet_warns_of_nothing():
    population = make(2, policy_delay=50).learn(2 * 28)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        agent = population[1]
    assert agent._n_updates == agent._loss_watch._step.item() == 8
    assert agent.critic.optimizer.state
    assert not agent.actor.optimizer.state


def test_a_copy_of_an_agent_changes_neither_the_population_nor_its_random_numbers():
    def train(copies):
        population = make(2)
        population.learn(2 * 40)
        if copies:
            agent = population.agent(0, env=Pushed())
            agent.learn(30, reset_num_timesteps=False)
            assert agent._n_updates == 20 + 30
        return population

    th.manual_seed(0)
    population = train(True)
    expected = train(False)
    for name, value in expected.policy.state_dict().items():
        assert th.equal(population.policy.state_dict()[name], value)
    np.testing.assert_array_equal(population.replay_buffer.actions, expected.replay_buffer.actions)
    state = th.get_rng_state()
    population[0]
    assert th.equal(th.get_rng_state(), state)


@pytest.mark.parametrize(
    "look",
    [
        lambda population: population[1],
        list,
        lambda population: population.agent(0, env=Pushed()),
        lambda population: population[0].save(io.BytesIO()),
    ],
    ids=["one", "all", "with an environment", "saved"],
)
@pytest.mark.parametrize("agents", [2, [dict(seed=None), dict(seed=3)]], ids=["seeds", "a seed"])
@pytest.mark.filterwarnings("ignore:Nothing is learnt")
def test_looking_at_agents_changes_no_random_action(look, agents):
    def random_actions(look):
        population = make(agents)

        def callback(*_):
            look(population)
            return True

        np.random.seed(0)  # noqa: NPY002
        th.manual_seed(0)
        population.action_space.seed(0)
        return population.learn(2 * 15, callback).replay_buffer.actions[:15]

    np.testing.assert_array_equal(random_actions(look), random_actions(len))


@pytest.mark.parametrize(
    ("change", "read"),
    [
        (lambda agent: setattr(agent.policy.selector, "samples", 5), lambda each: each.policy.selector.samples),
        (lambda agent: setattr(agent, "cem_samples", 5), lambda each: each.policy.selector.samples),
        (lambda agent: agent.policy_kwargs.update(n_critics=1), lambda each: each.policy_kwargs["n_critics"]),
        (
            lambda agent: agent.replay_buffer_kwargs.update(handle_timeout_termination=False),
            lambda each: each.replay_buffer_kwargs["handle_timeout_termination"],
        ),
        (lambda agent: agent.action_space.high.fill(9), lambda each: each.action_space.high.tolist()),
        (lambda agent: agent.observation_space.high.fill(9), lambda each: each.observation_space.high.tolist()),
    ],
    ids=["selector", "its argument", "policy_kwargs", "replay_buffer_kwargs", "action space", "observation space"],
)
def test_what_is_changed_on_a_copy_of_an_agent_is_not_changed_in_the_population(change, read):
    kwargs = dict(policy_kwargs=dict(n_critics=2), replay_buffer_kwargs=dict(handle_timeout_termination=True))
    population = make(2, **kwargs)
    before = read(population)
    agent = population[0]
    change(agent)
    assert read(agent) != before
    assert read(population) == read(population[0]) == read(population[1]) == before


def test_an_agent_goes_on_from_its_own_transitions():
    population = make(3).learn(3 * 40)
    agent = population.agent(1, env=Pushed())
    np.testing.assert_array_equal(agent.replay_buffer.actions[:40, 0], population.replay_buffer.actions[:40, 1])
    assert (agent.replay_buffer.n_envs, agent.replay_buffer.size(), agent.replay_buffer.buffer_size) == (1, 40, 500)
    agent.learn(20, reset_num_timesteps=False)
    assert (agent.num_timesteps, agent._n_updates, agent.replay_buffer.size()) == (60, 40, 60)


@pytest.mark.filterwarnings("ignore:The policy's loss has not reached a plateau")
def test_offline_training_trains_each_agents_actor_at_the_end(monkeypatch):
    monkeypatch.setattr(CGP, "train_policy", functools.partialmethod(CGP.train_policy, max_steps=300))
    population = make(2, policy_training="offline", learning_rate=1e-2)
    before = list(population)
    assert population.policy.inference == "cem"
    population.learn(2 * 40)
    assert population.policy.inference == "actor"
    for index, agent in enumerate(population):
        assert agent.policy.inference == "actor"
        observations = th.as_tensor(population.replay_buffer.observations[:40, index])
        target = agent.policy.select_actions(observations, agent.critic).actions
        errors = [(each.actor(observations) - target).square().mean().item() for each in (agent, before[index])]
        assert errors[0] < 0.85 * errors[1]


def test_raw_images_are_not_scaled():
    class Images(Pushed):
        observation_space = spaces.Box(0, 255, (3, 6, 6), np.uint8)

        def observe(self):
            return self.np_random.integers(0, 256, (3, 6, 6), np.uint8)

    observations = np.random.default_rng(0).integers(0, 256, (2, 3, 6, 6), np.uint8)
    for scales in (True, False):
        population = make(2, env=make_env(2, Images), policy_kwargs=dict(normalize_images=scales), policy_loss="qgp")
        actions, _ = population.predict(observations)
        for index, agent in enumerate(population):
            np.testing.assert_allclose(actions[index], agent.predict(observations[index])[0], atol=1e-5)


def test_an_index_is_an_integer():
    with pytest.raises(TypeError, match="cannot be interpreted as an integer"):
        make(2)[0:1]
    assert make(2)[np.int64(-1)].seed == 1
