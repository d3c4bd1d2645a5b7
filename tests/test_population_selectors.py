"""A selector that is set on a population's policy is that of the agents, is checked by ``learn``, and is saved."""

import warnings

import pytest
import torch as th
from populations import VARIANTS, make, make_env

from sb3_cgp import CEM, CGP, TrainingCheckpointCallback
from sb3_cgp.population import Population
from sb3_cgp.selectors import MPPI, ActorCEM, ActorOnly, ActorStart


@pytest.mark.parametrize(
    ("variant", "selector"),
    [
        ("CGP", MPPI(2, 6, 3)),
        ("CGP", ActorCEM(2, 8, 3)),
        ("CGP-Light", MPPI(2, 6, 3)),
        ("CGP-Light", MPPI(2, 6, 3, start=ActorStart())),
        ("CGP-Light", CEM(1, 8, 2)),
        ("from the actor, offline", MPPI(2, 6, 3)),
        ("MPPI", CEM(1, 8, 2)),
        ("QGP", ActorOnly()),
    ],
    ids=str,
)
@pytest.mark.parametrize("way", ["save", "resume"])
@pytest.mark.usefixtures("short_policy_training")
@pytest.mark.filterwarnings("ignore:The policy's loss has not reached a plateau")
def test_it_is_that_of_the_agents_and_is_saved(way, variant, selector, tmp_path):
    population = make(2, **VARIANTS[variant])
    given = population.policy_kwargs, [dict(each) for each in population.agents]
    for each in (MPPI(3, 6, 3), selector):
        population.policy.selector = each
        assert population[1].policy.selector == each
        population.save(tmp_path / "population")
    if way == "save":
        loaded = Population.load(tmp_path / "population", make_env(2))
    else:
        population.learn(2 * 25, TrainingCheckpointCallback(2 * 10, tmp_path / "state"))
        loaded = Population.resume(tmp_path / "state", make_env(2))
    loaded.save(tmp_path / "again")
    for each in (population, loaded, Population.load(tmp_path / "again", make_env(2))):
        assert each.policy.selector == each[0].policy.selector == selector
        # What it was made with is as it was
        assert (each.policy_kwargs, each.agents) == given
    assert loaded.learn(2 * 30).policy.selector == selector
    loaded[1].save(tmp_path / "agent")
    assert CGP.load(tmp_path / "agent").policy.selector == selector


def test_its_check_does_not_repeat_the_warnings_of_the_constructor():
    with pytest.warns(UserWarning, match="cem_samples=8, .*has no effect"):
        population = make(2, cem_samples=8, policy_kwargs=dict(net_arch=[8], selector=MPPI(2, 6, 3)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        population.learn(2 * 25)


@pytest.mark.parametrize("variant", ["CGP", "CGP-Light", "MPPI"])
def test_a_selector_that_is_changed_in_place_is_saved(variant, tmp_path):
    population = make(2, **VARIANTS[variant])
    population.policy.selector.samples = 12
    population.save(tmp_path / "population")
    loaded = Population.load(tmp_path / "population")
    assert loaded.policy.selector.samples == loaded[1].policy.selector.samples == 12


@pytest.mark.parametrize(
    ("variant", "selector", "name"),
    [
        ("CGP", ActorOnly(), "policy_loss"),
        ("CEM", ActorOnly(), "policy_loss"),
        ("CGP, offline", ActorOnly(), "policy_loss"),
        ("CGP", MPPI, "selector"),
        ("CGP", "mppi", "selector"),
        ("CGP", None, "selector"),
        ("CGP", ActorCEM(1, 6, 2, actor_fraction=1.0, actor_std=0.0), "selector"),
        ("CEM", MPPI(2, 6, 3, start=ActorStart()), "selector"),
    ],
    ids=str,
)
def test_one_that_does_not_fit_is_refused_by_learn_in_the_words_of_a_cgp_alone(variant, selector, name):
    population = make(2, **VARIANTS[variant])
    alone = population.agent(0, env=make_env(1))
    suitable = population.policy.selector
    messages = []
    for model in (alone, population):
        model.policy.selector = selector
        with pytest.raises(ValueError, match=f"`{name}`") as error:
            model.learn(2 * 25)
        messages.append(str(error.value))
    assert messages[0] == messages[1]
    assert population.num_timesteps == 0
    population.policy.selector = suitable
    before = population.policy.critics.weights[0].clone()
    population.learn(2 * 25)
    assert not th.equal(population.policy.critics.weights[0], before)
