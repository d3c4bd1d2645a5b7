"""Selectors besides the paper's CEM: from the actor's action, MPPI, and the actor alone, with which CGP is SB3's TD3."""

import math

import numpy as np
import oracles
import pytest
import torch as th
from environments import Doubles
from stable_baselines3 import DDPG, TD3
from stable_baselines3.common.noise import NormalActionNoise
from torch import nn

import sb3_cgp.core.policies as core_policies
from sb3_cgp import CEM, CGP, MlpPolicy
from sb3_cgp.fast.scoring import q_score
from sb3_cgp.selectors import MPPI, ActorCEM, ActorOnly, ActorStart
from sb3_cgp.selectors.policies import CGPPolicy

LIGHT = dict(cem_start="actor", cem_iterations=1, cem_samples=16)


class Seen:
    """A score that keeps the actions that it was asked for, and rates one coordinate, or what it is given."""

    def __init__(self, score=lambda actions: -actions.square().sum(dim=2)):
        self.score, self.actions = score, []

    def __call__(self, actions):
        self.actions.append(actions.clone())
        return self.score(actions)


def make_model(**kwargs):
    arguments = dict(learning_starts=50, buffer_size=1_000, batch_size=16, seed=0, policy_kwargs=dict(net_arch=[16]))
    return CGP("MlpPolicy", "Pendulum-v1", **(arguments | kwargs))


# --- The first samples ---


@pytest.mark.parametrize("n_proposals", [1, 3])
@pytest.mark.parametrize("make", [lambda: ActorCEM(2, 16, 4), lambda: MPPI(2, 16, 4, start=ActorStart())])
def test_proposals_are_among_the_first_samples_as_they_are(make, n_proposals):
    proposals = th.rand(5, n_proposals, 2) * 2 - 1
    proposals[0] = 1.0
    seen = Seen()
    make().select(seen, 5, 2, proposals=proposals)
    assert th.equal(seen.actions[0][:, :n_proposals], proposals)
    assert seen.actions[0].shape == seen.actions[1].shape == (5, 16, 2)


def test_the_shares_of_the_first_samples():
    """Of 1,000 samples: the proposal, 300 around it, and 699 of the prior; each before tanh as its Gaussian says."""
    proposal = th.tensor([[[0.5, -0.9]]])
    seen = Seen()
    th.manual_seed(0)
    ActorCEM(1, 1_000, 6, actor_fraction=0.3, actor_std=0.2).select(seen, 1, 2, proposals=proposal)
    samples = seen.actions[0][0].atanh()
    around, prior = samples[1:301], samples[301:]
    standard_error = 1 / math.sqrt(300)
    assert th.allclose(around.mean(dim=0), proposal[0, 0].atanh(), atol=4 * 0.2 * standard_error)
    assert th.allclose(around.std(dim=0), th.full((2,), 0.2), rtol=4 * standard_error)
    assert th.allclose(prior.mean(dim=0), th.zeros(2), atol=4 * standard_error)
    assert th.allclose(prior.std(dim=0), th.ones(2), rtol=4 * standard_error)


def test_samples_around_a_saturated_action_differ():
    seen = Seen()
    ActorCEM(1, 16, 6).select(seen, 1, 1, proposals=th.ones(1, 1, 1))
    assert len(seen.actions[0][0, 1:9].unique()) == 8
    assert (seen.actions[0][0, 1:9] > 0.95).all()


def test_several_proposals_are_surrounded_in_turn():
    proposals = th.tensor([[[-0.8], [0.0], [0.8]]])
    seen = Seen()
    ActorCEM(1, 16, 6, actor_fraction=1.0, actor_std=1e-4).select(seen, 1, 1, proposals=proposals)
    expected = proposals[0].repeat(6, 1)[:16]
    assert th.allclose(seen.actions[0][0], expected, atol=1e-3)


def test_more_proposals_than_samples():
    seen = Seen()
    ActorCEM(1, 4, 2).select(seen, 3, 1, proposals=th.rand(3, 9, 1))
    assert seen.actions[0].shape == (3, 4, 1)


def test_without_share_of_the_prior_and_without_std_the_actors_action_comes_back():
    proposals = th.rand(7, 1, 3) * 2 - 1
    # All samples have the same value but for rounding: the proposal itself is the best
    nearest = Seen(lambda actions: -(actions - proposals).abs().sum(dim=2))
    for iterations in (1, 3):
        selection = ActorCEM(iterations, 16, 6, actor_fraction=1.0, actor_std=0.0).select(nearest, 7, 3, proposals=proposals)
        assert th.equal(selection.actions, proposals[:, 0])
        assert th.allclose(selection.std, th.zeros(7, 3), atol=1e-6)


def test_without_proposals_it_is_the_papers_cem():
    score = Seen()
    th.manual_seed(3)
    expected = CEM(3, 20, 4).select(score, 6, 2)
    th.manual_seed(3)
    selection = ActorCEM(3, 20, 4).select(score, 6, 2)
    assert th.equal(selection.actions, expected.actions)
    assert th.equal(selection.elites, expected.elites)


# --- The search ---


def oracle_actor_cem(score, draws, n_elites, proposal, n_around, std):
    """CEM from the actor for one state of one dimension, a loop for every line: the best action of all samples."""
    centre = math.atanh(max(min(proposal, 0.99), -0.99))
    pairs = [(centre, proposal)]
    for index, draw in enumerate(draws[0][1:]):
        sample = centre + std * draw if index < n_around else draw
        pairs.append((sample, math.tanh(sample)))
    for iteration in range(len(draws)):
        pairs.sort(key=lambda pair: score(pair[1]), reverse=True)
        elites = [sample for sample, _ in pairs[:n_elites]]
        best = pairs[0]
        if iteration + 1 < len(draws):
            mean = sum(elites) / n_elites
            deviation = math.sqrt(sum((sample - mean) ** 2 for sample in elites) / n_elites)
            samples = [mean + deviation * draw for draw in draws[iteration + 1][1:]]
            pairs = [best, *((sample, math.tanh(sample)) for sample in samples)]
    return best[1], elites


@pytest.mark.parametrize("iterations", [1, 2, 4])
def test_is_a_loop_for_every_line_of_it(iterations):
    def score(action):
        return math.sin(9 * action) - action**2

    proposals = th.tensor([-0.6, 0.3, 0.999, -1.0]).view(4, 1, 1)
    th.manual_seed(1)
    draws = [th.randn(4, 12, 1) for _ in range(iterations)]
    th.manual_seed(1)
    selection = ActorCEM(iterations, 12, 3, actor_fraction=0.4, actor_std=0.1).select(
        lambda actions: (9 * actions).sin().sub(actions.square()).squeeze(2), 4, 1, proposals=proposals
    )
    for state in range(4):
        of_state = [draw[state, :, 0].tolist() for draw in draws]
        action, elites = oracle_actor_cem(score, of_state, 3, proposals[state].item(), 5, 0.1)
        assert selection.actions[state].item() == pytest.approx(action, abs=1e-5)
        assert selection.elites[state, :, 0].tolist() == pytest.approx(elites, abs=1e-4)


def test_the_best_so_far_is_never_lost():
    """On a landscape of noise alone, each iteration's best is at least as good as all before it."""
    generator = th.Generator().manual_seed(0)
    values = {}

    def score(actions):
        keys = [tuple(action) for action in actions.flatten(0, 1).tolist()]
        for key in keys:
            values.setdefault(key, th.rand((), generator=generator).item())
        return th.tensor([values[key] for key in keys]).view(actions.shape[:2])

    selection = ActorCEM(6, 10, 3).select(score, 4, 2, proposals=th.rand(4, 1, 2))
    found = [values[tuple(action)] for action in selection.actions.tolist()]
    n_seen = 4 * (10 + 5 * 9)
    assert len(values) == n_seen
    # The highest of all states' values is among the four
    assert max(found) == max(values.values())


def two_maxima(actions):
    """A maximum of height 1 at -0.5, and of height 2 at 0.5, both narrow."""
    action = actions[:, :, 0]
    return th.exp(-((action + 0.5) / 0.05).square()) + 2 * th.exp(-((action - 0.5) / 0.05).square())


def test_from_the_lower_of_two_maxima_it_finds_the_higher_as_often_as_its_prior_samples_say():
    """
    The actor sits on the lower maximum. The higher one wins where a sample of the prior lies in the region in which its values
    exceed the lower one's height: the probability follows from the normal distribution.
    """
    n_states, n_samples = 20_000, 16
    width = 0.05 * math.sqrt(math.log(2))
    ends = [math.atanh(end) for end in (0.5 - width, 0.5 + width)]
    in_region = 0.5 * (math.erf(ends[1] / math.sqrt(2)) - math.erf(ends[0] / math.sqrt(2)))
    for fraction, n_prior in ((0.5, 7), (0.0, 15), (1.0, 0)):
        th.manual_seed(0)
        selector = ActorCEM(1, n_samples, 6, actor_fraction=fraction, actor_std=0.05)
        actions = selector.select(two_maxima, n_states, 1, proposals=th.full((n_states, 1, 1), -0.5)).actions
        share = (actions > 0).float().mean().item()
        expected = 1 - (1 - in_region) ** n_prior
        assert share == pytest.approx(expected, abs=4 * math.sqrt(expected * (1 - expected) / n_states) + 1e-9)


def test_nan_ranks_last():
    proposals = th.tensor([[[0.2]], [[0.4]]])

    def score(actions):
        values = -actions.square().squeeze(2)
        values[0, 0] = th.nan
        return values

    selection = ActorCEM(1, 8, 2).select(score, 2, 1, proposals=proposals)
    assert selection.actions[0] != proposals[0, 0]
    assert selection.actions.isfinite().all()


# --- MPPI ---


def test_mppi_is_a_loop_for_every_line_of_it():
    temperature, n_elites = 0.7, 4
    th.manual_seed(2)
    draws = [th.randn(3, 10, 1) for _ in range(3)]
    th.manual_seed(2)
    selection = MPPI(3, 10, n_elites, "mean", temperature).select(lambda actions: (9 * actions).sin().squeeze(2) * 50, 3, 1)
    for state in range(3):
        mean, std = 0.0, 1.0
        for iteration in draws:
            samples = [mean + std * draw for draw in iteration[state, :, 0].tolist()]
            values = [50 * math.sin(9 * math.tanh(sample)) for sample in samples]
            scale = np.std(values) * temperature
            best = sorted(range(10), key=lambda index: values[index], reverse=True)[:n_elites]
            weights = [math.exp((values[index] - values[best[0]]) / scale) for index in best]
            total = sum(weights)
            mean = sum(weight * samples[index] for weight, index in zip(weights, best, strict=True)) / total
            variance = sum(weight * (samples[index] - mean) ** 2 for weight, index in zip(weights, best, strict=True)) / total
            std = math.sqrt(variance)
        assert selection.actions[state].item() == pytest.approx(math.tanh(mean), abs=1e-4)


def test_mppi_with_a_high_temperature_is_cem_by_the_mean_and_with_a_low_one_the_best():
    def score(actions):
        return -(actions - 0.3).square().sum(dim=2)

    th.manual_seed(0)
    expected = CEM(3, 30, 5, "mean").select(score, 4, 2).actions
    th.manual_seed(0)
    assert th.allclose(MPPI(3, 30, 5, "mean", temperature=1e6).select(score, 4, 2).actions, expected, atol=1e-4)
    th.manual_seed(0)
    best = CEM(1, 30, 5).select(score, 4, 2).actions
    for result in ("mean", "best"):
        th.manual_seed(0)
        assert th.allclose(MPPI(1, 30, 5, result, temperature=1e-4).select(score, 4, 2).actions, best, atol=1e-5)


def test_mppi_does_not_depend_on_the_scale_of_values():
    chosen = []
    for scale in (1e-3, 1.0, 1e4):
        th.manual_seed(0)
        chosen.append(MPPI().select(lambda actions, scale=scale: scale * (7 * actions).sin().sum(dim=2), 5, 2).actions)
    assert th.allclose(chosen[0], chosen[1], atol=1e-3)
    assert th.allclose(chosen[2], chosen[1], atol=1e-3)


@pytest.mark.parametrize("value", [0.0, math.nan, math.inf])
def test_mppi_weighs_all_alike_where_values_tell_nothing(value):
    selection = MPPI(2, 8, 3).select(lambda actions: th.full(actions.shape[:2], value), 4, 2)
    assert selection.actions.isfinite().all()
    assert selection.elites.isfinite().all()


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: ActorCEM(actor_fraction=1.5), "fraction"),
        (lambda: ActorCEM(actor_std=-1.0), "std"),
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
        (lambda: make_model(cem_start="actor", policy_kwargs=dict(selector=CEM())), "cem_start"),
        (lambda: make_model(policy_kwargs=dict(actor_proposes=True)), "policy_kwargs['actor_proposes']"),
        (lambda: make_model(policy_kwargs=dict(selector=ActorOnly())), "policy_loss"),
        (lambda: make_model(policy_loss=None, policy_kwargs=dict(selector=ActorOnly())), "policy_loss"),
        (
            lambda: make_model(policy_loss="qgp", policy_training="offline", policy_kwargs=dict(selector=ActorOnly())),
            "policy_training",
        ),
        (lambda: ActorOnly().select(Seen(), 1, 1), "proposals"),
        (lambda: CGP(core_policies.CGPPolicy, "Pendulum-v1", cem_start="actor", buffer_size=10), "policy"),
    ],
)
def test_wrong_arguments_are_refused_by_name(make, name):
    with pytest.raises(ValueError, match="must be") as error:
        make()
    assert f"`{name}`" in str(error.value)


# --- In CGP ---


def record_proposals(model):
    """Replace a model's selector by one that keeps the proposals that it is given."""
    given = []

    class Recording(ActorCEM):
        def select(self, score, n_states, action_dim, device="cpu", proposals=None):
            given.append(None if proposals is None else proposals.clone())
            return super().select(score, n_states, action_dim, device, proposals)

    model.policy.selector = Recording(1, 16, 6)
    return given


def test_acting_and_the_loss_start_from_the_actor_and_bootstrap_actions_from_the_averaged_one():
    model = make_model(**LIGHT, tau=0.5).learn(70)
    given = record_proposals(model)
    model.policy.set_training_mode(False)
    batch = model.replay_buffer.sample(16)
    with th.no_grad():
        actor, averaged = model.actor(batch.observations), model.actor_target(batch.next_observations)
    assert not th.allclose(model.actor_target(batch.observations), actor)
    model.policy.select_actions(batch.observations, model.critic)
    model.policy.select_actions(batch.next_observations, model.critic_target)
    assert th.equal(given[0][:, 0], actor)
    assert th.equal(given[1][:, 0], averaged)
    given.clear()
    # One environment step and one gradient step: acting, bootstrap actions, the policy's loss
    model.learn(1, reset_num_timesteps=False)
    assert [proposals.shape for proposals in given] == [(1, 1, 1), (16, 1, 1), (16, 1, 1)]


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


# --- The actor alone: SB3's TD3 and DDPG ---


def noise():
    return NormalActionNoise(np.zeros(2), 0.1 * np.ones(2))


@pytest.mark.parametrize(
    ("algorithm", "own", "kwargs"),
    [
        (TD3, dict(policy_delay=2), dict(policy_delay=2, target_update_interval=2)),
        (TD3, dict(policy_delay=3, gradient_steps=2), dict(policy_delay=3, target_update_interval=3, gradient_steps=2)),
        (
            TD3,
            dict(policy_kwargs=dict(net_arch=[16], n_critics=1), target_policy_noise=0.0, policy_delay=1),
            dict(policy_kwargs=dict(net_arch=[16], n_critics=1), target_policy_noise=0.0, target_update_interval=1),
        ),
        (
            DDPG,
            dict(),
            dict(policy_kwargs=dict(net_arch=[16], n_critics=1), target_policy_noise=0.1, target_noise_clip=0.0,
                 target_update_interval=1),
        ),
        (TD3, dict(n_steps=3), dict(n_steps=3, policy_delay=2, target_update_interval=2)),
    ],
)  # fmt: skip
def test_the_actor_alone_is_sb3s_own_to_the_bit(algorithm, own, kwargs):
    """The core's networks and SB3's optimizer: the same operations, in the same order, on the same random numbers."""
    equals_sb3(algorithm, own, kwargs, CGPPolicy, dict(optimizer_kwargs=dict(fused=False)), tolerance=0)


def test_the_actor_alone_is_sb3s_td3_but_for_the_fast_networks_rounding():
    equals_sb3(TD3, dict(policy_delay=2), dict(policy_delay=2, target_update_interval=2), MlpPolicy, dict(), tolerance=1e-4)


def equals_sb3(algorithm, own, kwargs, policy, policy_kwargs, tolerance):
    """Compare networks, minibatches, noise, targets, losses, updates and actions, after hundreds of steps."""
    common = dict(
        env=Doubles(), learning_starts=100, buffer_size=1_000, batch_size=32, learning_rate=1e-3, seed=0, device="cpu"
    )
    common["policy_kwargs"] = dict(net_arch=[16])
    theirs = algorithm("MlpPolicy", action_noise=noise(), **(common | own)).learn(300)
    kwargs = common | kwargs
    kwargs["policy_kwargs"] = dict(selector=ActorOnly(), **policy_kwargs, **kwargs["policy_kwargs"])
    ours = CGP(policy, policy_loss="qgp", action_noise=noise(), **kwargs).learn(300)
    assert ours._n_updates == theirs._n_updates >= 200
    expected, actual = theirs.policy.state_dict(), ours.policy.state_dict()
    assert actual.keys() == expected.keys()
    for name, value in expected.items():
        th.testing.assert_close(actual[name], value, rtol=0, atol=tolerance, msg=name)
    np.testing.assert_allclose(ours.replay_buffer.actions[:300], theirs.replay_buffer.actions[:300], atol=tolerance)
    # The training has changed what was there
    untrained = algorithm("MlpPolicy", **(common | own)).policy.state_dict()
    assert any(not th.allclose(untrained[name], value, atol=1e-2) for name, value in expected.items())
