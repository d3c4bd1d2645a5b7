"""Arguments that are changed on a model: they are checked, take effect at once, and are resumed."""

import pytest
from stable_baselines3.common.callbacks import BaseCallback
from trainings import parameters_equal

from sb3_cgp import CEM, CGP, TrainingCheckpointCallback
from sb3_cgp.selectors import MPPI, ActorCEM, ActorOnly, ActorStart

ARGUMENTS = dict(learning_starts=50, batch_size=16, seed=0)
CHANGES = {
    "sizes": dict(cem_iterations=4, cem_samples=32),
    "start": dict(cem_start="actor", cem_actor_std=0.1, cem_actor_fraction=0.75),
    "result": dict(cem_result="mean"),
    "loss": dict(policy_loss="qgp", policy_delay=2),
    "discount": dict(gamma=0.5),
    "returns": dict(n_steps=2),
    "learning rate": dict(learning_rate=1e-4),
    "learning rates": dict(learning_rate=2e-4, actor_learning_rate=2e-3),
}


def make_model(selector=None, **kwargs):
    return CGP("MlpPolicy", "Pendulum-v1", policy_kwargs=dict(net_arch=[16], selector=selector), **ARGUMENTS, **kwargs)


class Change(BaseCallback):
    """Set attributes of the model at step 60."""

    def __init__(self, **values):
        super().__init__()
        self.values = values

    def _on_step(self):
        if self.num_timesteps == 60:
            for name, value in self.values.items():
                setattr(self.model, name, value)
        return True


@pytest.mark.parametrize("values", CHANGES.values(), ids=CHANGES)
def test_a_change_has_an_effect_and_is_resumed(tmp_path, values):
    def train(steps, folder, **values):
        callbacks = [Change(**values), TrainingCheckpointCallback(40, tmp_path / folder)]
        return make_model(n_steps=3).learn(steps, callbacks)

    straight = train(100, "straight", **values)
    assert not parameters_equal(straight, train(100, "unchanged"))
    train(90, "stopped", **values)
    resumed = CGP.resume(tmp_path / "stopped", "Pendulum-v1")
    assert resumed.num_timesteps == 90
    assert parameters_equal(resumed.learn(100), straight)


def test_the_policy_has_what_the_arguments_say():
    model = make_model()
    model.cem_elites, model.cem_samples, model.cem_iterations = 3, 8, 1
    assert model.policy.selector == CEM(1, 8, 3)
    model.cem_start = "actor"
    assert model.policy.selector == ActorCEM(1, 8, 3, "best", 0.5, 0.3)
    model.cem_dtype = "float32"
    assert model.policy.cem_dtype == "float32"
    model.inference = "averaged_actor"
    assert model.policy.inference == "averaged_actor"
    # Without a loss no actor is trained: CEM acts
    model.cem_start, model.inference = "prior", None
    model.policy_loss = None
    assert model.policy.inference == "cem"


def test_a_learning_rate_is_that_of_the_next_gradient_step():
    model = make_model().learn(60)
    rates = lambda: [network.optimizer.param_groups[0]["lr"] for network in (model.critic, model.actor)]  # noqa: E731
    assert rates() == [1e-3, 1e-3]
    model.learning_rate = 1e-4
    model.train(1, 16)
    assert rates() == [1e-4, 1e-4]
    model.actor_learning_rate = lambda remaining: 2e-4
    model.train(1, 16)
    assert rates() == [1e-4, 2e-4]


def test_a_schedule_that_was_set_stays_when_the_actors_rate_changes():
    model = make_model()
    model.lr_schedule = lambda remaining: 5e-4
    model.actor_learning_rate = 1e-4
    assert (model.lr_schedule(1.0), model.actor_lr_schedule(1.0)) == (5e-4, 1e-4)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("cem_samples", 4, "`cem_elites` is 6, but must be at most `cem_samples`"),
        ("policy_loss", "nope", "`policy_loss` is 'nope', but must be"),
        ("policy_delay", 0, "`policy_delay` is 0, but must be"),
        ("cem_dtype", "float64", "`cem_dtype` is 'float64', but must be"),
        ("cem_actor_fraction", 1.5, "`cem_actor_fraction` is 1.5, but must be"),
        ("learning_rate", -1.0, "`learning_rate` is -1.0, but must be"),
        ("actor_learning_rate", "fast", "`actor_learning_rate` is 'fast', but must be"),
        ("inference", "critic", "`inference` is 'critic', but must be"),
    ],
)
def test_a_wrong_change_is_refused_and_changes_nothing(name, value, message):
    model = make_model()
    before, selector = getattr(model, name), model.policy.selector
    with pytest.raises(ValueError, match=message):
        setattr(model, name, value)
    assert getattr(model, name) == before
    assert model.policy.selector is selector


def test_a_change_that_contradicts_the_start_is_refused():
    model = make_model(cem_start="actor", cem_samples=16)
    selector = model.policy.selector
    with pytest.raises(ValueError, match="`cem_start` is 'actor', but must be 'prior'"):
        model.policy_loss = None
    assert (model.policy_loss, model.policy.selector) == ("cgp", selector)


def test_a_selector_of_the_users_stays_and_a_warning_says_so():
    model = make_model(MPPI())
    with pytest.warns(UserWarning, match=r"cem_samples=8 has no effect, as the selector MPPI\("):
        model.cem_samples = 8
    assert model.policy.selector == MPPI()
    with pytest.warns(UserWarning, match="cem_iterations=7, cem_samples=200 has no effect"):
        make_model(MPPI(), cem_samples=200, cem_iterations=7)
    # One that was set on the policy, and one whose attributes were changed, too
    for selector in (MPPI(), CEM(samples=128)):
        model = make_model()
        model.policy.selector = selector
        with pytest.warns(UserWarning, match=r"cem_samples=8 has no effect, as the selector \w+\(.* replaces CEM"):
            model.cem_samples = 8
        assert model.policy.selector == selector


def test_a_choice_on_the_policy_stays_when_other_arguments_change():
    model = make_model()
    model.policy.inference, model.policy.cem_dtype = "cem", "float32"
    with model.policy.acting_by("averaged_actor"):
        model.cem_samples = 32
        assert model.policy.inference == "averaged_actor"
    model.policy_delay, model.target_policy_noise = 2, 0.1
    assert (model.policy.inference, model.policy.cem_dtype) == ("cem", "float32")
    model.inference = "actor"
    assert model.policy.inference == "actor"


@pytest.mark.parametrize(
    ("selector", "twin", "other"),
    [
        (CEM(), CEM(2, 64, 6), CEM(3)),
        (ActorCEM(), ActorCEM(1, 16, 6), ActorCEM(actor_std=0.1)),
        (MPPI(), MPPI(temperature=0.5), MPPI(start=ActorStart())),
        (ActorOnly(), ActorOnly(), CEM()),
    ],
)
def test_selectors_of_equal_arguments_are_equal(tmp_path, selector, twin, other):
    """... so that SB3's `load` accepts the same `policy_kwargs`."""
    assert selector == twin
    assert selector != other
    model = make_model(selector, policy_loss="qgp")
    model.save(tmp_path / "model")
    CGP.load(tmp_path / "model", policy_kwargs=dict(net_arch=[16], selector=twin))
    with pytest.raises(ValueError, match="policy kwargs"):
        CGP.load(tmp_path / "model", policy_kwargs=dict(net_arch=[16], selector=other))


@pytest.mark.parametrize(
    "selector",
    [
        ActorCEM(samples=1, elites=1),
        ActorCEM(actor_fraction=1.0, actor_std=0.0),
        MPPI(start=ActorStart(1.0, 0.0)),
    ],
)
def test_an_actor_that_would_imitate_itself_is_refused(selector):
    with pytest.raises(
        ValueError, match=r"`selector` is .*, but must be one with samples that differ from the actor's action"
    ):
        make_model(selector)
    make_model(selector, policy_loss="qgp")
