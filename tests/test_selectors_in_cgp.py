"""Selectors besides the paper's CEM in a training of CGP."""

import math
from copy import deepcopy

import oracles
import pytest
import torch as th
from scores import Seen
from small_models import WithSelector, step_without_learning
from torch import nn
from trainings import parameters_equal

import sb3_cgp.core.policies as core_policies
from sb3_cgp import CEM, CGP, Selection
from sb3_cgp.fast.scoring import q_score
from sb3_cgp.selectors import MPPI, ActorCEM, ActorOnly, ActorStart

LIGHT = dict(cem_start="actor", cem_iterations=1, cem_samples=16)


def make_model(policy="MlpPolicy", **kwargs):
    arguments = dict(learning_starts=50, buffer_size=1_000, batch_size=16, seed=0, policy_kwargs=dict(net_arch=[16]))
    return CGP(policy, "Pendulum-v1", **(arguments | kwargs))


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: ActorCEM(actor_fraction=1.5), "actor_fraction"),
        (lambda: ActorCEM(actor_std=-1.0), "actor_std"),
        (lambda: ActorCEM(samples=3), "elites"),
        (lambda: ActorStart(math.nan), "fraction"),
        (lambda: MPPI(temperature=0.0), "temperature"),
        (lambda: MPPI(temperature="hot"), "temperature"),
        (lambda: MPPI(elites=100), "elites"),
        (lambda: MPPI(start="actor"), "start"),
        (lambda: make_model(cem_start="policy"), "cem_start"),
        (lambda: make_model(cem_start="actor", cem_actor_fraction=-0.1), "cem_actor_fraction"),
        (lambda: make_model(cem_start="actor", cem_actor_std=math.inf), "cem_actor_std"),
        (lambda: make_model(cem_start="actor", policy_loss=None), "cem_start"),
        (lambda: make_model(policy_loss=None, policy_kwargs=dict(selector=ActorCEM())), "selector"),
        (lambda: make_model(policy_loss=None, policy_kwargs=dict(selector=MPPI(1, 16, start=ActorStart()))), "selector"),
        (lambda: make_model(cem_start="actor", policy_kwargs=dict(selector=CEM())), "cem_start"),
        (lambda: make_model(cem_start="actor", policy=WithSelector), "cem_start"),
        (lambda: make_model(cem_start="actor", cem_samples=1, cem_elites=1), "cem_samples"),
        (lambda: make_model(**LIGHT, cem_actor_fraction=1.0, cem_actor_std=0.0), "cem_actor_std"),
        # 15.2 samples, rounded: all but the actor's action itself
        (lambda: make_model(**LIGHT, cem_actor_fraction=0.95, cem_actor_std=0.0), "cem_actor_std"),
        (lambda: make_model(policy_kwargs=dict(actor_proposes=True)), "policy_kwargs['actor_proposes']"),
        (lambda: make_model(policy_kwargs=dict(selector=ActorOnly())), "policy_loss"),
        (lambda: make_model(policy_loss=None, policy_kwargs=dict(selector=ActorOnly())), "policy_loss"),
        (
            lambda: make_model(policy_loss="qgp", policy_training="offline", policy_kwargs=dict(selector=ActorOnly())),
            "policy_training",
        ),
        (lambda: make_model(policy_kwargs=dict(selector=MPPI)), "selector"),
        (lambda: make_model(policy_kwargs=dict(selector="mppi")), "selector"),
        (lambda: ActorOnly().select(Seen(), 1, 1), "proposals"),
        (lambda: CGP(core_policies.CGPPolicy, "Pendulum-v1", cem_start="actor", buffer_size=10), "policy"),
    ],
)
def test_wrong_arguments_are_refused_by_name(make, name):
    with pytest.raises(ValueError, match="must be") as error:
        make()
    assert f"`{name}`" in str(error.value)


@pytest.mark.parametrize(
    "arguments",
    [
        dict(policy_loss="qgp", cem_samples=1, cem_elites=1),
        dict(policy_loss="qgp", cem_actor_fraction=1.0, cem_actor_std=0.0),
        dict(cem_samples=2, cem_elites=1),
        dict(LIGHT, cem_actor_fraction=1.0, cem_actor_std=0.1),
        # 14.4 samples, rounded: one of the prior is left
        dict(LIGHT, cem_actor_fraction=0.9, cem_actor_std=0.0),
    ],
)
def test_a_search_near_the_actor_is_accepted_where_the_actor_can_learn(arguments):
    model = make_model(**(dict(cem_start="actor", diagnostics=False) | arguments))
    before = [parameter.clone() for parameter in model.actor.parameters()]
    model.learn(60)
    assert any(not th.equal(*pair) for pair in zip(before, model.actor.parameters(), strict=True))


def test_a_selector_that_names_the_number_of_its_samples_otherwise_is_accepted():
    class Random:
        """The best of random actions and of the proposal."""

        takes_proposals, start, count = True, ActorStart(), 8

        def select(self, score, n_states, action_dim, device="cpu", proposals=None):
            actions = 2 * th.rand(n_states, self.count, action_dim) - 1
            actions = actions if proposals is None else th.cat([proposals, actions], dim=1)
            best = actions[th.arange(n_states), score(actions).argmax(dim=1)]
            return Selection(best, best.unsqueeze(1))

    model = make_model(policy_kwargs=dict(net_arch=[16], selector=Random()))
    before = [parameter.clone() for parameter in model.actor.parameters()]
    model.learn(60)
    assert any(not th.equal(*pair) for pair in zip(before, model.actor.parameters(), strict=True))


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (
            lambda: make_model(cem_start="actor").policy.selector,
            "ActorCEM(iterations=2, samples=64, elites=6, result='best', actor_fraction=0.5, actor_std=0.3)",
        ),
        (
            lambda: make_model(
                cem_start="actor", cem_iterations=3, cem_samples=20, cem_elites=5, cem_result="mean",
                cem_actor_fraction=0.25, cem_actor_std=0.1
            ).policy.selector,
            "ActorCEM(iterations=3, samples=20, elites=5, result='mean', actor_fraction=0.25, actor_std=0.1)",
        ),
        (ActorCEM, "ActorCEM(iterations=1, samples=16, elites=6, result='best', actor_fraction=0.5, actor_std=0.3)"),
        (MPPI, "MPPI(iterations=2, samples=64, elites=6, result='mean', temperature=0.5, start=None)"),
        (ActorStart, "ActorStart(fraction=0.5, std=0.3)"),
    ],
    ids=["CGP's defaults", "CGP's arguments", "ActorCEM", "MPPI", "ActorStart"],
)  # fmt: skip
def test_a_selector_is_what_it_was_asked_to_be_and_else_what_the_published_numbers_were_made_with(make, expected):
    assert repr(make()) == expected


def record_proposals(model):
    """Keep the proposals that a model's selector is given."""
    given, select = [], model.policy.selector.select

    def recording(*args, proposals):
        given.append(proposals.squeeze(1).clone())
        return select(*args, proposals=proposals)

    model.policy.selector.select = recording
    return given


@pytest.mark.parametrize(
    "arguments",
    [LIGHT, dict(policy_kwargs=dict(net_arch=[16], selector=MPPI(1, 16, start=ActorStart())))],
    ids=["CEM", "MPPI"],
)
def test_acting_and_the_loss_start_from_the_actor_and_bootstrap_actions_from_the_averaged_one(arguments):
    model = make_model(**arguments, actor_learning_rate=1e-2, tau=0.1, diagnostics=False).learn(71)
    actor, averaged = model.actor, deepcopy(model.actor_target)
    given = record_proposals(model)
    observations = step_without_learning(model)
    for proposals, of_choice, proposes, other in zip(
        given, observations, (actor, averaged, actor), (averaged, actor, averaged), strict=True
    ):
        assert th.equal(proposals, proposes(of_choice))
        assert not th.allclose(proposals, other(of_choice), atol=1e-2)


def test_the_actor_proposes_in_evaluation_mode_and_keeps_its_mode():
    class Dropped(nn.Sequential):
        def __init__(self):
            super().__init__(nn.Dropout(0.5), nn.BatchNorm1d(3))

    model = make_model(**LIGHT).learn(60)
    model.actor.mu = nn.Sequential(Dropped(), *model.actor.mu)
    model.policy.set_training_mode(True)
    statistics = model.actor.mu[0][1].running_mean.clone()
    given = record_proposals(model)
    observations = th.rand(8, 3)
    for _ in range(2):
        model.policy.select_actions(observations, model.critic)
    assert th.equal(given[0], given[1])
    assert th.equal(model.actor.mu[0][1].running_mean, statistics)
    assert model.actor.training
    assert model.actor.mu[0].training


def test_a_compiled_policy_learns_as_the_policy_does():
    def train(change):
        model = make_model(**LIGHT)
        model.policy = change(model.policy)
        model.cem_samples = 12
        return model.learn(70)

    compiled = train(lambda policy: th.compile(policy, backend="eager"))
    assert parameters_equal(compiled, train(lambda policy: policy))


def test_offline_the_prior_alone_serves_until_the_actor_is_trained(monkeypatch):
    monkeypatch.setattr("sb3_cgp.core.offline.ROUND", 10)
    given, select = [], ActorCEM.select

    def recording(self, score, n_states, action_dim, device="cpu", proposals=None):
        given.append(proposals is not None)
        return select(self, score, n_states, action_dim, device, proposals)

    monkeypatch.setattr(ActorCEM, "select", recording)
    model = make_model(**LIGHT, policy_training="offline", diagnostics=False).learn(60)
    first = given.index(True)
    # At least 10 choices of rollouts and 10 of bootstrap actions, and then the policy's training alone
    assert first >= 20
    assert all(given[first:])
    assert len(given) - first == model.actor.optimizer.state[next(model.actor.parameters())]["step"]
    assert model.policy.actor_proposes


@pytest.mark.parametrize("arguments", [dict(policy_training="offline"), dict(policy_loss=None)])
def test_a_selector_of_the_users_own_may_require_proposals(arguments):
    """None without a trained actor, as the documentation of selectors says."""

    class Own:
        takes_proposals = True

        def select(self, score, n_states, action_dim, device, proposals):
            assert proposals is None
            actions = th.zeros(n_states, action_dim, device=device)
            return Selection(actions, actions.unsqueeze(1))

    model = make_model(**arguments, policy_kwargs=dict(net_arch=[8], selector=Own()))
    assert not model.policy.select_actions(th.rand(2, 3), model.critic).actions.any()


@pytest.mark.parametrize("policy_loss", ["cgp", "qgp"])
@pytest.mark.parametrize("selector", [MPPI(1, 16), MPPI(2, 8, start=ActorStart()), ActorCEM(2, 8, 3)])
def test_cgp_trains_by_every_selector(selector, policy_loss):
    model = make_model(policy_loss=policy_loss, policy_kwargs=dict(net_arch=[16], selector=selector)).learn(100)
    assert model._n_updates == 50
    assert all(parameter.isfinite().all() for parameter in model.policy.parameters())


@pytest.mark.parametrize("n_samples", [4, 16])
@pytest.mark.parametrize("dtype", [th.float32, th.bfloat16])
def test_few_samples_are_scored_as_the_network_does(n_samples, dtype):
    th.manual_seed(0)
    network = nn.Sequential(nn.Linear(5, 64), nn.ReLU(), nn.Linear(64, 64), nn.ReLU(), nn.Linear(64, 1))
    features, actions = th.randn(32, 3), th.rand(32, n_samples, 2) * 2 - 1
    with th.no_grad():
        values = q_score(network, features, dtype)(actions)
    layers = network[::2]
    for state in range(0, 32, 5):
        for index in range(n_samples):
            inputs = th.cat([features[state], actions[state, index]])
            expected = oracles.mlp([layer.weight for layer in layers], [layer.bias for layer in layers], inputs).item()
            assert values[state, index].item() == pytest.approx(expected, abs=1e-5 if dtype == th.float32 else 2e-2)
