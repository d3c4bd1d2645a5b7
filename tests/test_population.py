"""A population of agents: each of them computes what a CGP alone computes, given the same minibatches and random numbers."""

import functools
import itertools
import math
import re
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch as th
from environments import Doubles
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from test_cuda_graphs import StandIn
from torch import nn

from sb3_cgp import CEM, CGP, CGPPolicy, TrainingCheckpointCallback
from sb3_cgp.fast import cuda_graphs
from sb3_cgp.fast.device_replay import DeviceReplayBuffer
from sb3_cgp.population import Population, PopulationEvalCallback, evaluate_population, training
from sb3_cgp.population.adam import AgentAdam
from sb3_cgp.population.replay import copied_column, sample_columns
from sb3_cgp.selectors import MPPI, ActorCEM, ActorOnly, ActorStart

SMALL = dict(
    learning_starts=20, buffer_size=500, batch_size=8, cem_samples=6, cem_elites=2, cem_dtype="float32", seed=0, device="cpu"
)
# Agents that differ in everything that they may
AGENTS = [
    dict(),
    dict(
        seed=7, learning_rate=3e-3, tau=0.05, gamma=0.9, target_policy_noise=0.5, target_noise_clip=0.1, policy_delay=3,
        target_update_interval=1, learning_starts=22, action_noise=NormalActionNoise(np.zeros(2), 0.3 * np.ones(2)),
    ),
    dict(
        learning_rate="lin_1e-2", actor_learning_rate=2e-4, gamma=0.5, tau=1.0, target_policy_noise=0.0, policy_delay=1,
        target_update_interval=5,
    ),
]  # fmt: skip
TD3 = dict(policy_loss="qgp", policy_delay=2)
VARIANTS = {
    "CGP": dict(),
    "QGP": dict(policy_loss="qgp"),
    "CEM": dict(policy_loss=None),
    "CGP, offline": dict(policy_training="offline"),
    "mean of the elites": dict(cem_result="mean", cem_iterations=3),
    "CGP-Light": dict(cem_start="actor", cem_iterations=1),
    "from the actor, offline": dict(cem_start="actor", policy_training="offline"),
    "MPPI": dict(policy_kwargs=dict(selector=MPPI(2, 6, 3))),
    "MPPI from the actor": dict(policy_kwargs=dict(selector=MPPI(2, 6, 3, start=ActorStart()))),
    "ActorCEM": dict(policy_kwargs=dict(selector=ActorCEM(2, 8, 3))),
    "TD3": dict(**TD3, policy_kwargs=dict(selector=ActorOnly())),
    "DDPG": dict(**TD3, policy_kwargs=dict(selector=ActorOnly(), n_critics=1)),
    "n-step": dict(n_steps=3),
    "networks": dict(policy_kwargs=dict(net_arch=dict(pi=[6], qf=[9, 5, 7]), activation_fn=nn.Tanh, n_critics=3)),
}


class Pushed(Doubles):
    """Rewards depend on the observation, and every second episode ends by a termination."""

    episode = 0

    def ends_by_timeout(self):
        self.episode += 1
        return self.episode % 2 == 0

    def step(self, action):
        observation, _, *rest = super().step(action)
        return observation, float(action @ observation[:2]), *rest


def make_env(n_envs=3, env=Pushed):
    return DummyVecEnv([env] * n_envs)


def make(agents=3, env=None, **kwargs):
    arguments = SMALL | kwargs
    arguments["policy_kwargs"] = dict(net_arch=[8, 8]) | arguments.get("policy_kwargs", {})
    n_agents = agents if isinstance(agents, int) else len(agents)
    return Population("MlpPolicy", make_env(n_agents) if env is None else env, agents, **arguments)


@pytest.fixture
def float64(monkeypatch):
    """Networks in double precision, so that rounding does not decide between two samples of CEM."""
    monkeypatch.setattr("stable_baselines3.common.policies.preprocess_obs", lambda obs, *args, **kwargs: obs.double())
    th.set_default_dtype(th.float64)
    yield
    th.set_default_dtype(th.float32)


class Step:
    """What one gradient step of a population was given: minibatches, what was due, progress, and draws, in their order."""

    def __init__(self, population, inputs):
        *self.batch, self.due = inputs
        self.progress = population._current_progress_remaining
        self.draws = []


def record(population, monkeypatch):
    """Record all gradient steps of a population."""
    steps, randn, carry_out = [], th.randn, population._carry_out

    def drawing(*args, **kwargs):
        steps[-1].draws.append(randn(*args, **kwargs))
        return steps[-1].draws[-1].clone()

    def carrying_out(due, inputs):
        steps.append(Step(population, inputs))
        with monkeypatch.context() as patch:
            patch.setattr(th, "randn", drawing)
            return carry_out(due, inputs)

    monkeypatch.setattr(population, "_carry_out", carrying_out)
    return steps


class OneBatch(ReplayBuffer):
    """A buffer that returns a given minibatch."""

    def __init__(self, batch):
        self.batch = batch

    def sample(self, batch_size, env=None):
        assert batch_size == len(self.batch.rewards)
        return self.batch


def repeat_alone(alone, index, step, monkeypatch):
    """Let a CGP alone do the gradient step that an agent of a population did."""
    observations, actions, next_observations, dones, rewards, discounts = (field[index] for field in step.batch)
    given = None if alone.n_steps == 1 else discounts.unsqueeze(1)
    # The core multiplies `dones` by gamma, which their data type rounds
    dones = dones.unsqueeze(1).to(th.get_default_dtype())
    fields = observations, actions, next_observations, dones, rewards.unsqueeze(1), given
    alone.replay_buffer = OneBatch(ReplayBufferSamples(*fields))
    alone._current_progress_remaining = step.progress
    n_agents = len(step.batch[0])
    draws = iter(
        [draw.unflatten(0, (n_agents, -1))[index] if draw.shape[0] != n_agents else draw[index] for draw in step.draws]
    )

    def drawing(shape, **kwargs):
        draw = next(draws)
        assert draw.shape == shape
        return draw.clone()

    with monkeypatch.context() as patch:
        patch.setattr(th, "randn", drawing)
        patch.setattr(th.Tensor, "normal_", lambda self, mean, std: self.copy_(mean + std * drawing(self.shape)))
        alone.train(1, alone.batch_size)
    return draws


def adam_state(model, name):
    optimizer = getattr(model, name).optimizer
    return [optimizer.state[parameter] for group in optimizer.param_groups for parameter in group["params"]]


def assert_alike(agent, alone, **tolerance):
    """Compare networks, averages, and the optimizers' moments and step counts."""
    for name, value in alone.policy.state_dict().items():
        th.testing.assert_close(agent.policy.state_dict()[name], value, msg=name, **tolerance)
    for name in ("actor", "critic"):
        for own, expected in zip(adam_state(agent, name), adam_state(alone, name), strict=True):
            assert own.keys() == expected.keys()
            for key, value in expected.items():
                th.testing.assert_close(own[key], value, msg=key, check_dtype=False, **tolerance)
    assert agent._n_updates == alone._n_updates


def alone_like(population, index):
    """Make the CGP that agent i would be alone, and check that the population's begins with its networks."""
    alone = CGP("MlpPolicy", Pushed(), **population.agents[index], device="cpu", diagnostics=False)
    alone.set_logger(population.logger)
    return alone


@pytest.mark.parametrize("variant", VARIANTS)
def test_an_agent_computes_what_a_cgp_alone_computes(variant, float64, monkeypatch):
    kwargs = VARIANTS[variant]
    agents = [own | {name: kwargs[name] for name in ("policy_delay",) if name in kwargs and own} for own in AGENTS]
    population = make(agents, gradient_steps=5, **kwargs)
    initial = [{name: value.clone() for name, value in agent.policy.state_dict().items()} for agent in population]
    steps = record(population, monkeypatch)
    # Offline training comes after the gradient steps that are compared here
    monkeypatch.setattr(population, "_train_policies", lambda: None)
    population.learn(3 * 63)
    assert len(steps) == 5 * 43
    assert list(population._agent_updates) == [5 * 43, 5 * 41, 5 * 43]
    for index, agent in enumerate(population):
        alone = alone_like(population, index)
        assert all(th.equal(initial[index][name], value) for name, value in alone.policy.state_dict().items())
        for step in steps:
            if step.due[1, index]:
                repeat_alone(alone, index, step, monkeypatch)
        assert_alike(agent, alone, rtol=1e-6, atol=1e-9)
        moved = (agent.critic.state_dict()[name] - initial[index][f"critic.{name}"] for name in agent.critic.state_dict())
        assert max(each.abs().max().item() for each in moved) > 0.01
        assert all(adam_state(agent, "actor")) == population._trains_online


@pytest.mark.parametrize("variant", ["CGP", "TD3"])
def test_an_agent_is_a_cgp_alone_in_single_precision_too(variant, monkeypatch):
    population = make(AGENTS, gradient_steps=5, **VARIANTS[variant])
    steps = record(population, monkeypatch)
    population.learn(3 * 63)
    for index, agent in enumerate(population):
        alone = alone_like(population, index)
        for step in steps:
            if step.due[1, index]:
                repeat_alone(alone, index, step, monkeypatch)
        for name, value in alone.policy.state_dict().items():
            th.testing.assert_close(agent.policy.state_dict()[name], value, rtol=0, atol=2e-3, msg=name)


@pytest.mark.parametrize("variant", ["CGP", "QGP", "CEM", "CGP-Light", "MPPI from the actor", "TD3", "n-step"])
def test_a_population_of_one_is_a_cgp_alone_from_the_first_step(variant, float64):
    """Environment, warm-up, acting, noise, minibatches and gradient steps, on the same random numbers."""
    # A gamma that is exact in single precision, to which the core rounds it
    kwargs = VARIANTS[variant] | dict(action_noise=NormalActionNoise(np.zeros(2), 0.1 * np.ones(2)), gamma=0.5)
    population = make(1, **kwargs).learn(230)
    alone = CGP("MlpPolicy", make_env(1), **population.agents[0], device="cpu").learn(230)
    assert alone._n_updates == 210
    np.testing.assert_allclose(population.replay_buffer.actions[:230], alone.replay_buffer.actions[:230], atol=1e-4)
    np.testing.assert_array_equal(population.replay_buffer.observations[:230], alone.replay_buffer.observations[:230])
    # Buffers round to single precision, and MPPI magnifies that
    assert_alike(population[0], alone, rtol=1e-3, atol=1e-4)


def test_agents_differ_and_each_begins_as_its_seed_says():
    population = make(3, env="Pendulum-v1").learn(3 * 40)
    assert population.num_timesteps == 120
    assert [agent.num_timesteps for agent in population] == [40] * 3
    assert [agent.seed for agent in population] == [0, 1, 2]
    observations = population.replay_buffer.observations[0, :, :]
    for index in range(3):
        alone = CGP("MlpPolicy", "Pendulum-v1", **population.agents[index], device="cpu").learn(1)
        np.testing.assert_array_equal(observations[index], alone.replay_buffer.observations[0, 0])
    weights = [agent.actor.mu[0].weight for agent in population]
    assert not any(th.allclose(*pair) for pair in itertools.combinations(weights, 2))
    assert all(weight.isfinite().all() for weight in weights)
    with pytest.raises(IndexError):
        population[3]
    assert th.equal(population[-1].actor.mu[0].weight, weights[2])


def test_gradient_steps_follow_the_steps_of_one_environment():
    population = make(2, train_freq=(3, "step"), gradient_steps=-1).learn(2 * 38)
    # Rollouts of three steps, the seventh of which ends beyond the warm-up
    assert population.num_timesteps == 2 * 39
    assert list(population._agent_updates) == [3 * 7, 3 * 7]
    alone = CGP("MlpPolicy", Pushed(), **population.agents[0], device="cpu").learn(38)
    assert alone._n_updates == 21


# --- Adam ---


@pytest.mark.parametrize("dtype", [th.float32, th.float64])
def test_adam_is_pytorchs_for_each_agent_that_is_due(dtype):
    th.manual_seed(0)
    shapes = [(2, 3, 4, 5), (2, 3, 1, 4)]
    parameters = [th.randn(shape, dtype=dtype) for shape in shapes]
    optimizer = AgentAdam(parameters, betas=(0.8, 0.99), eps=1e-6).to(dtype)
    rates = [1e-1, 1e-3, 3e-2]
    optimizer.rates.copy_(th.tensor(rates, dtype=dtype).view(3, 1, 1))
    alone = [[nn.Parameter(each[:, agent].clone()) for each in parameters] for agent in range(3)]
    theirs = [th.optim.Adam(own, lr=rate, betas=(0.8, 0.99), eps=1e-6) for own, rate in zip(alone, rates, strict=True)]
    for step in range(1, 301):
        due = th.tensor([True, step % 3 == 0, step > 50])
        gradients = [th.randn(shape, dtype=dtype) * 10 ** th.randn(()) for shape in shapes]
        # Agents that are not due may have any gradient
        given = [th.where(due.view(3, 1, 1), gradient, math.nan) for gradient in gradients]
        optimizer.step(parameters, given, due.view(3, 1, 1))
        for agent in range(3):
            if due[agent]:
                for parameter, gradient in zip(alone[agent], gradients, strict=True):
                    parameter.grad = gradient[:, agent].clone()
                theirs[agent].step()
        tolerance = dict(rtol=0, atol=1e-9 if dtype == th.float64 else 1e-4)
        for agent in range(3):
            for parameter, own in zip(parameters, alone[agent], strict=True):
                th.testing.assert_close(parameter[:, agent], own.detach(), **tolerance)
    assert optimizer.steps.flatten().tolist() == [300, 100, 250]


def test_an_agent_that_is_not_due_stays_as_it_is_to_the_bit():
    population = make([dict(), dict(learning_starts=10_000), dict(policy_delay=10_000, target_update_interval=10_000)])
    before = [agent.policy.state_dict() for agent in population]
    population.learn(3 * 60)
    changed = [
        {
            name.partition(".")[0]
            for name, value in agent.policy.state_dict().items()
            if not th.equal(before[index][name], value)
        }
        for index, agent in enumerate(population)
    ]
    assert changed == [{"actor", "critic", "actor_target", "critic_target"}, set(), {"critic"}]
    assert population[1]._n_updates == len(population[1].critic.optimizer.state) == 0
    assert len(population[2].critic.optimizer.state) > 0
    assert len(population[2].actor.optimizer.state) == 0


# --- Replay ---


@pytest.mark.parametrize("n_steps", [1, 3])
def test_each_agent_samples_its_own_column(n_steps):
    population = make([dict(gamma=0.9), dict(gamma=0.5), dict(gamma=0.1)], n_steps=n_steps)
    buffer = population.replay_buffer
    for row in range(40):
        state = np.repeat(100.0 * np.arange(3) + row, 3).reshape(3, 3)
        ends = np.array([row % 7 == 6, False, row % 5 == 4])
        infos = [{"TimeLimit.truncated": bool(end) and index == 2} for index, end in enumerate(ends)]
        buffer.add(state, state + 0.5, np.full((3, 2), row / 100), np.arange(3) + 1.0, ends, infos)
    batch = sample_columns(buffer, 200, population._numbers.gammas)
    rows = batch.observations[:, :, 0] - 100 * th.arange(3).unsqueeze(1)
    assert ((rows >= 0) & (rows < 40)).all()
    assert batch.observations.shape == batch.next_observations.shape == (3, 200, 3)
    # Every row is drawn, and agents draw different ones
    assert all(len(own.unique()) > 35 for own in rows)
    assert not th.equal(rows[0], rows[1])
    th.testing.assert_close(batch.actions, (rows / 100).unsqueeze(2).expand(-1, -1, 2).float())
    for agent, gamma in enumerate((0.9, 0.5, 0.1)):
        for row, done, reward, discount, next_row in zip(
            rows[agent].int().tolist(), batch.dones[agent], batch.rewards[agent],
            batch.discounts[agent].expand(200), batch.next_observations[agent, :, 0] - 100 * agent - 0.5, strict=True,
        ):  # fmt: skip
            period = (7, 1_000, 5)[agent]
            length = min(n_steps, period - row % period, 40 - row)
            assert next_row == row + length - 1
            assert done == (agent == 0 and (row + length) % 7 == 0)
            assert reward.item() == pytest.approx((agent + 1) * sum(gamma**k for k in range(length)), rel=1e-5)
            assert discount.item() == pytest.approx(gamma**length, rel=1e-5)


def test_a_buffer_on_the_networks_device_gives_the_same_samples_and_columns():
    population = make(3).learn(3 * 40)
    host = population.replay_buffer
    device = DeviceReplayBuffer(3 * 500, Doubles.observation_space, Doubles.action_space, device="cpu", n_envs=3)
    for name in device.row_fields:
        getattr(device, name)[:] = th.as_tensor(getattr(host, name))
    device.pos = host.pos
    set_random_seed(1)
    expected = sample_columns(host, 30, population._numbers.gammas)
    set_random_seed(1)
    for field, value in zip(sample_columns(device, 30, population._numbers.gammas), expected, strict=True):
        assert th.equal(field.float(), value.float())
    own = copied_column(device, 2)
    assert (type(own), own.n_envs, own.size()) == (DeviceReplayBuffer, 1, 40)
    assert th.equal(own.actions[:40, 0], th.as_tensor(host.actions[:40, 2]))
    own.actions[:] = 7
    assert not (device.actions == 7).any()
    assert own.sample(5).actions.shape == (5, 2)


# --- Failures ---


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
    with pytest.warns(UserWarning, match="has failed"), pytest.raises(ValueError, match="All agents have failed"):
        make(2, learning_rate=1e30).learn(2 * 80)


# --- Arguments ---


@pytest.mark.parametrize(
    ("make_it", "name"),
    [
        (lambda: make(0, env=make_env(1)), "agents"),
        (lambda: make([], env=make_env(1)), "agents"),
        (lambda: make([dict(), 3], env=make_env(2)), "agents[1]"),
        (lambda: make([dict(), dict(batch_size=16)]), "agents[1]['batch_size']"),
        (lambda: make([dict(), dict(cem_samples=16)]), "agents[1]['cem_samples']"),
        (lambda: make([dict(), dict(n_steps=2)]), "agents[1]['n_steps']"),
        (lambda: make([dict(), dict(policy_kwargs=dict(net_arch=[4]))]), "agents[1]['policy_kwargs']"),
        (lambda: make([dict(), dict(policy_training="offline")]), "agents[1]['policy_training']"),
        (lambda: make([dict(), dict(learning_speed=1)]), "arguments"),
        (lambda: make(2, learning_speed=1), "arguments"),
        (lambda: make([dict(), dict(tau=2.0)]), "tau"),
        (lambda: make([dict(), dict(learning_rate="fast")]), "learning_rate"),
        (lambda: make([dict(), dict(policy_delay=0)]), "policy_delay"),
        (lambda: make(2, policy_loss="huber"), "policy_loss"),
        (lambda: make(3, env=make_env(2)), "env.num_envs"),
        (lambda: make(2, train_freq=(1, "episode")), "train_freq"),
        (lambda: make(2, cem_dtype="bfloat16"), "cem_dtype"),
        (lambda: make(2, optimize_memory_usage=True), "optimize_memory_usage"),
        (lambda: make(2, replay_buffer_class=ReplayBuffer), "replay_buffer_class"),
        (lambda: make(2, policy_kwargs=dict(optimizer_class=th.optim.SGD)), "policy_kwargs['optimizer_class']"),
        (
            lambda: make(2, policy_kwargs=dict(optimizer_kwargs=dict(weight_decay=0.1))),
            "policy_kwargs['optimizer_kwargs']['weight_decay']",
        ),
        (lambda: make(2, policy_kwargs=dict(activation_fn=nn.PReLU)), "policy_kwargs"),
        (lambda: Population("CnnPolicy", make_env(2), 2), "policy"),
        (lambda: Population(type("Own", (CGPPolicy,), {}), make_env(2), 2), "policy"),
        (lambda: make(2, env=VecNormalize(make_env(2))), "env"),
        (
            lambda: make(
                [
                    dict(action_noise=NormalActionNoise(np.zeros(2), np.ones(2))),
                    dict(action_noise=OrnsteinUhlenbeckActionNoise(np.zeros(2), np.ones(2))),
                ]
            ),
            "agents[1]['action_noise']",
        ),
        (lambda: make(3).predict(np.zeros((2, 3))), "observation"),
        (lambda: evaluate_population(make(3), make_env(2)), "env.num_envs"),
    ],
)
def test_what_is_not_possible_is_refused_by_name(make_it, name):
    with pytest.raises(ValueError, match="must be") as error:
        make_it()
    assert f"`{name}`" in str(error.value)


# --- Agents as ordinary models ---


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


# --- Saving, resuming, evaluating ---


def test_a_population_is_saved_and_loaded(tmp_path):
    population = make(AGENTS).learn(3 * 60)
    population.save(tmp_path / "population")
    population.save_replay_buffer(tmp_path / "buffer")
    loaded = Population.load(tmp_path / "population", env=make_env())
    loaded.load_replay_buffer(tmp_path / "buffer")
    observations = np.random.default_rng(0).normal(size=(3, 3))
    np.testing.assert_array_equal(loaded.predict(observations)[0], population.predict(observations)[0])
    for index, agent in enumerate(loaded):
        assert_alike(agent, population[index], rtol=0, atol=0)
        assert (agent.gamma, agent.policy_delay) == (population[index].gamma, population[index].policy_delay)
    loaded.learn(3 * 20, reset_num_timesteps=False)
    assert list(loaded._agent_updates) == [60, 58, 60]
    with pytest.raises(ValueError, match="`tau`"):
        Population.load(tmp_path / "population", tau=0.5)
    assert len(Population.load(tmp_path / "population")) == 3


def test_failures_outlive_saving(tmp_path):
    with pytest.warns(UserWarning, match="Agent 0 has failed"):
        population = make([dict(learning_rate=1e30), dict()]).learn(2 * 60)
    population.save(tmp_path / "population")
    loaded = Population.load(tmp_path / "population", env=make_env(2))
    assert loaded.failed == population.failed
    before = loaded[0].policy.state_dict()
    loaded.learn(2 * 60, reset_num_timesteps=False)
    assert all(th.equal(loaded[0].policy.state_dict()[name], value) for name, value in before.items())


class Stop(BaseCallback):
    """Stops the training at a step."""

    def __init__(self, at):
        super().__init__()
        self.at = at

    def _on_step(self):
        return self.num_timesteps < self.at


@pytest.mark.filterwarnings("ignore:A test_population.Stop was among the callbacks")
@pytest.mark.parametrize("variant", ["CGP", "TD3"])
def test_a_population_resumes_as_if_it_had_not_stopped(variant, tmp_path):
    noise = OrnsteinUhlenbeckActionNoise(np.zeros(1), 0.3 * np.ones(1))
    agents = [own | dict(action_noise=noise) for own in AGENTS]

    def train(folder, *callbacks):
        callbacks = [TrainingCheckpointCallback(3 * 20, folder), *callbacks]
        return make(agents, env="Pendulum-v1", **VARIANTS[variant]).learn(3 * 90, callback=callbacks)

    whole = train(tmp_path / "whole")
    train(tmp_path / "stopped", Stop(3 * 70))
    resumed = Population.resume(tmp_path / "stopped", make_vec_env("Pendulum-v1", 3))
    assert resumed.num_timesteps == 180
    resumed.learn(3 * 90)
    assert list(resumed._agent_updates) == list(whole._agent_updates)
    for name, value in whole.policy.state_dict().items():
        assert th.equal(resumed.policy.state_dict()[name], value), name
    np.testing.assert_array_equal(resumed.replay_buffer.actions, whole.replay_buffer.actions)


def test_all_agents_are_evaluated_at_once(tmp_path):
    callback = PopulationEvalCallback(
        make_vec_env("Pendulum-v1", 2, seed=5), eval_freq=25, n_eval_episodes=2, log_path=str(tmp_path)
    )
    population = make(2, env="Pendulum-v1").learn(2 * 60, callback=callback)
    assert callback.mean_rewards.shape == (2, 2)
    with np.load(tmp_path / "evaluations.npz") as saved:
        assert saved["timesteps"].tolist() == [25, 50]
        assert saved["results"].shape == saved["ep_lengths"].shape == (2, 2, 2)
        np.testing.assert_array_equal(saved["results"].mean(axis=2), callback.mean_rewards)
    # Each agent acts in its own environment: as it does alone in an environment of the same seed
    returns, lengths = evaluate_population(population, make_vec_env("Pendulum-v1", 2, seed=9), 1)
    assert (lengths == 200).all()
    for index in range(2):
        env = make_vec_env("Pendulum-v1", 1, seed=9 + index)
        alone, _ = evaluate_policy(population[index], env, n_eval_episodes=1)
        assert returns[index, 0] == pytest.approx(alone, rel=1e-3)
    assert returns[0, 0] != returns[1, 0]


def test_sb3s_callbacks_and_log_take_a_population(tmp_path):
    evaluation = EvalCallback(make_env(2), eval_freq=10, n_eval_episodes=4, verbose=0, warn=False)
    checkpoints = CheckpointCallback(20, tmp_path)
    population, log = make(2, policy_delay=5), Log()
    population.set_logger(Logger(None, [log]))
    population.learn(2 * 45, callback=[evaluation, checkpoints], log_interval=2)
    assert np.isfinite(evaluation.last_mean_reward)
    assert len(Population.load(tmp_path / "rl_model_80_steps")) == 2
    logged = {name: value for row in log.rows for name, value in row.items()}
    for name in ("critic_loss", "actor_loss", "q_value", "learning_rate", "failed_agents"):
        assert math.isfinite(logged[f"train/{name}"])
    assert logged["train/n_updates"] == 24
    assert logged["eval/mean_reward"] == evaluation.last_mean_reward


class Log(KVWriter):
    """Keeps what is logged."""

    def __init__(self):
        self.rows = []

    def write(self, key_values, key_excluded, step=0):
        self.rows.append({**key_values, "step": step})

    def close(self):
        pass


# --- CUDA graphs ---


@pytest.mark.parametrize("variant", ["CGP", "CGP-Light", "TD3", "CEM"])
def test_recorded_gradient_steps_are_the_ordinary_ones(variant, monkeypatch):
    ordinary = make(AGENTS, **VARIANTS[variant]).learn(3 * 80)
    monkeypatch.setattr(training, "has_cuda_graphs", lambda device: True)
    monkeypatch.setattr(cuda_graphs, "Recording", StandIn)
    monkeypatch.setattr(StandIn, "made", 0)
    recorded = make(AGENTS, **VARIANTS[variant]).learn(3 * 80)
    assert StandIn.made > 0
    # Acting, too
    assert None in {due for due, *_ in recorded._recorded}
    assert not any(each._stays_eager for each in recorded._recorded.values())
    for name, value in ordinary.policy.state_dict().items():
        assert th.equal(recorded.policy.state_dict()[name], value), name


@pytest.mark.usefixtures("gpu")
@pytest.mark.parametrize("variant", ["CGP", "QGP", "CGP-Light", "MPPI from the actor", "TD3", "CEM", "n-step"])
def test_on_a_gpu_gradient_steps_are_recorded_and_compute_the_same(variant):
    with warnings.catch_warnings():
        # Such as one that the host synchronizes
        warnings.simplefilter("error", UserWarning)
        recorded, ordinary = (
            make(AGENTS, device="cuda", cuda_graphs=cuda_graphs, **VARIANTS[variant]).learn(3 * 80)
            for cuda_graphs in (True, False)
        )
    assert any(each._recording is not None for each in recorded._recorded.values())
    assert not any(each._stays_eager for each in recorded._recorded.values())
    assert ordinary._recorded == {}
    for index, agent in enumerate(recorded):
        for name, value in ordinary[index].policy.state_dict().items():
            th.testing.assert_close(agent.policy.state_dict()[name], value, rtol=1e-3, atol=1e-3, msg=name)


def test_the_selector_is_unchanged():
    selector = CEM(3, 10, 2)
    population = make(2, policy_kwargs=dict(selector=selector))
    assert population.policy.selector is selector


# --- The page ---

PAGE = (Path(__file__).parent.parent / "docs" / "population.md").read_text()


@pytest.mark.parametrize("example", re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL), ids=range(3))
def test_the_pages_examples_run(example, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    names = {"__name__": "__main__"}
    exec(compile(example, "population.md", "exec"), names)
    if "evaluation" in names:
        assert names["evaluation"].mean_rewards.shape == (1, 3)
        assert CGP.load("agent_2").gamma == 0.95
