"""Selectors besides the paper's CEM in a training of CGP."""

import math
import threading
from copy import deepcopy

import numpy as np
import oracles
import pytest
import torch as th
from scores import Seen
from small_models import step_without_learning
from stable_baselines3.common.callbacks import BaseCallback
from torch import nn
from trainings import parameters_equal

import sb3_cgp.core.policies as core_policies
from sb3_cgp import CEM, CGP, MlpPolicy, Selection, TrainingCheckpointCallback
from sb3_cgp.fast.scoring import q_score
from sb3_cgp.selectors import MPPI, ActorCEM, ActorOnly, ActorStart

LIGHT = dict(cem_start="actor", cem_iterations=1, cem_samples=16)


class WithSelector(MlpPolicy):
    """A policy class of a user's, with a selector of its own."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **(dict(selector=CEM(1, 8, 4)) | kwargs))


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


def test_a_models_setting_is_saved_and_a_policys_too(tmp_path):
    model = make_model(**LIGHT, cem_actor_fraction=0.25, cem_actor_std=0.1).learn(60)
    model.save(tmp_path / "model")
    loaded = CGP.load(tmp_path / "model")
    assert repr(loaded.policy.selector) == repr(model.policy.selector)
    assert (loaded.policy.selector.start.fraction, loaded.policy.selector.start.std) == (0.25, 0.1)
    changed = CGP.load(tmp_path / "model", cem_start="prior")
    assert type(changed.policy.selector) is CEM
    model.policy.actor_proposes = False
    model.policy.save(tmp_path / "policy")
    policy = MlpPolicy.load(tmp_path / "policy")
    assert repr(policy.selector) == repr(model.policy.selector)
    assert policy.actor_proposes is False


class Fixed:
    """A selector without a comparison of its own."""

    def __init__(self, action):
        self.action = action

    def select(self, score, n_states, action_dim, device="cpu"):
        actions = th.full((n_states, action_dim), self.action, device=device)
        return Selection(actions, actions.unsqueeze(1))


@pytest.mark.parametrize("initial", [None, Fixed(0.2)], ids=["CEM", "the user's"])
@pytest.mark.parametrize("way", ["save", "resume"])
def test_a_selector_that_is_set_on_the_policy_is_saved(way, initial, tmp_path):
    sizes = dict(cem_samples=64, cem_elites=6)
    model = make_model(policy_kwargs=dict(net_arch=[16], selector=initial), inference="cem", **sizes)

    class Exchange(BaseCallback):
        def _on_step(self):
            if self.n_calls == 30:
                self.model.policy.selector = Fixed(0.7)
            return True

    model.learn(60, [Exchange(), TrainingCheckpointCallback(50, tmp_path / "state")])
    if way == "save":
        model.save(tmp_path / "model")
        loaded = CGP.load(tmp_path / "model")
    else:
        loaded = CGP.resume(tmp_path / "state", "Pendulum-v1")
    assert loaded.policy.selector.action == 0.7
    observation = np.zeros(3, np.float32)
    assert loaded.predict(observation)[0] == model.predict(observation)[0] == pytest.approx(1.4)
    # And once more
    loaded.save(tmp_path / "again")
    assert CGP.load(tmp_path / "again").policy.selector.action == 0.7


def test_other_selectors_of_a_model_that_is_loaded_are_set_on_its_policy(tmp_path):
    make_model(policy_kwargs=dict(net_arch=[16], selector=Fixed(0.2)), cem_samples=64, cem_elites=6).save(tmp_path / "model")
    with pytest.raises(ValueError, match=r"Leave `policy_kwargs` out.*`model\.policy\.selector = "):
        CGP.load(tmp_path / "model", policy_kwargs=dict(net_arch=[16], selector=Fixed(0.2)))


@pytest.mark.parametrize(
    ("arguments", "selector"),
    [
        (LIGHT, MPPI()),
        (LIGHT, ActorCEM(2, 32)),
        (dict(policy_kwargs=dict(net_arch=[16], selector=MPPI())), CEM()),
        (dict(policy=WithSelector), CEM()),
        (dict(policy=WithSelector), MPPI()),
        (dict(policy_loss="qgp"), ActorOnly()),
    ],
    ids=lambda value: None if isinstance(value, dict) else repr(value),
)
def test_whatever_selector_is_set_is_saved_and_the_model_remains_as_it_is(arguments, selector, tmp_path):
    model = make_model(**arguments)
    policy_kwargs = dict(model.policy_kwargs)
    for each in (MPPI(3), selector):
        model.policy.selector = each
        model.save(tmp_path / "model")
    assert model.policy_kwargs == policy_kwargs
    # An argument of no selector
    model.target_policy_noise = 0.1
    loaded = CGP.load(tmp_path / "model", env=model.get_env())
    assert type(loaded.policy.selector) is type(selector)
    assert loaded.learn(60).policy.selector == selector


class WithOwnSelector(MlpPolicy):
    """A policy whose selector refers to it, and holds what cannot be saved."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.selector = Fixed(0.5)
        self.selector.policy, self.selector.lock = [self], threading.Lock()


def test_a_selector_that_the_policy_makes_is_made_again(tmp_path):
    model = make_model(policy=WithOwnSelector)
    model.save(tmp_path / "model")
    loaded = CGP.load(tmp_path / "model")
    assert loaded.policy.selector.policy[0] is loaded.policy
    # One in its place is saved, and the policy's own again when it is back
    own, model.policy.selector = model.policy.selector, CEM()
    model.save(tmp_path / "model")
    assert CGP.load(tmp_path / "model").policy.selector == CEM()
    model.policy.selector = own
    model.save(tmp_path / "model")
    assert CGP.load(tmp_path / "model").policy.selector.action == 0.5


def test_arguments_that_a_saved_selector_replaces_are_named_when_a_model_is_loaded(tmp_path):
    model = make_model()
    model.policy.selector = MPPI()
    model.save(tmp_path / "model")
    with pytest.warns(UserWarning, match=r"cem_start='actor', cem_actor_std=0\.1 has no effect, as the selector MPPI"):
        CGP.load(tmp_path / "model", cem_start="actor", cem_actor_std=0.1)


@pytest.mark.parametrize("arguments", [{}, LIGHT])
def test_a_selector_that_is_changed_in_place_is_saved(arguments, tmp_path):
    model = make_model(**arguments)
    model.policy.selector.samples = 32
    model.save(tmp_path / "model")
    assert CGP.load(tmp_path / "model").policy.selector == model.policy.selector
    assert CGP.load(tmp_path / "model").policy.selector.samples == 32


@pytest.mark.parametrize(
    ("selector", "name"),
    [(ActorOnly(), "policy_loss"), (ActorCEM(2, 8, actor_fraction=1.0, actor_std=0.0), "selector"), (MPPI, "selector")],
)
def test_a_selector_that_is_set_on_the_policy_is_checked_when_a_training_begins(selector, name):
    model = make_model()
    model.policy.selector = selector
    with pytest.raises(ValueError, match=f"`{name}` is .*, but must be"):
        model.learn(60)
    model.policy.selector = CEM()
    assert model.learn(60).num_timesteps == 60


def test_the_actor_alone_acts_whatever_the_delay_of_its_training_was(tmp_path):
    """... as in TD3: an actor that was not trained yet is all that there is."""
    model = make_model(policy_loss="qgp", policy_delay=1_000, policy_kwargs=dict(net_arch=[16], selector=ActorOnly()))
    model.learn(60)
    model.policy_delay = 2
    model.save(tmp_path / "model")
    assert model.learn(60, reset_num_timesteps=False).num_timesteps == 120
    loaded, observations = CGP.load(tmp_path / "model"), th.rand(4, 3)
    assert th.equal(loaded.policy.select_actions(observations, loaded.critic).actions, loaded.actor(observations))


def test_saving_leaves_the_arguments_of_cem_as_they_are(tmp_path):
    model = make_model(**LIGHT)
    model.cem_samples = 12
    model.save(tmp_path / "model")
    assert "selector" not in model.policy_kwargs
    assert CGP.load(tmp_path / "model", cem_samples=9).policy.selector == ActorCEM(1, 9, 6)


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
