"""Selectors that are set on a model's policy: saved, loaded, resumed, and checked."""

import threading

import numpy as np
import pytest
import torch as th
from small_models import VARIANTS, WithSelector, make_model
from stable_baselines3.common.callbacks import BaseCallback

from sb3_cgp import CEM, CGP, MlpPolicy, Selection, TrainingCheckpointCallback
from sb3_cgp.selectors import MPPI, ActorCEM, ActorOnly


def test_a_models_setting_is_saved_and_a_policys_too(tmp_path):
    model = make_model(**VARIANTS["CGP-Light"], cem_actor_fraction=0.25, cem_actor_std=0.1).learn(60)
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
        (VARIANTS["CGP-Light"], MPPI()),
        (VARIANTS["CGP-Light"], ActorCEM(2, 32)),
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
    model = make_model(cem_samples=64, cem_elites=6)
    model.policy.selector = MPPI()
    model.save(tmp_path / "model")
    with pytest.warns(UserWarning, match=r"cem_start='actor', cem_actor_std=0\.1 has no effect, as the selector MPPI"):
        CGP.load(tmp_path / "model", cem_start="actor", cem_actor_std=0.1)


@pytest.mark.parametrize("arguments", [{}, VARIANTS["CGP-Light"]])
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
    model = make_model(**VARIANTS["CGP-Light"])
    model.cem_samples = 12
    model.save(tmp_path / "model")
    assert "selector" not in model.policy_kwargs
    assert CGP.load(tmp_path / "model", cem_samples=9).policy.selector == ActorCEM(1, 9, 2)
