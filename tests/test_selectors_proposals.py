"""CEM and MPPI from the actor's action: their first samples."""

import math

import pytest
import torch as th
from scores import Seen

from sb3_cgp import CEM
from sb3_cgp.selectors import MPPI, ActorCEM, ActorStart


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


# Whatever the score: it prefers the proposals, others, or none
SCORES = {
    "near": lambda actions, proposals: -(actions - proposals).abs().sum(dim=2),
    "far": lambda actions, proposals: (actions - proposals).abs().sum(dim=2),
    "small": lambda actions, proposals: -actions.abs().sum(dim=2),
    "constant": lambda actions, proposals: th.zeros(actions.shape[:2]),
}


@pytest.mark.parametrize("n_proposals", [1, 3])
@pytest.mark.parametrize("score", SCORES)
@pytest.mark.parametrize(
    "selector",
    [ActorCEM(1, 16, 6, actor_fraction=1.0, actor_std=0.0), MPPI(1, 16, 6, "best", start=ActorStart(1.0, 0.0))],
    ids=str,
)
def test_without_share_of_the_prior_and_without_std_the_actors_action_comes_back(selector, score, n_proposals):
    proposals = th.rand(7, 1, 3) * 2 - 1
    proposals[0], proposals[1] = 1.0, -1.0
    seen = Seen(lambda actions: SCORES[score](actions, proposals))
    selection = selector.select(seen, 7, 3, proposals=proposals.repeat(1, n_proposals, 1))
    assert th.equal(selection.actions, proposals[:, 0])
    assert th.allclose(selection.std, th.zeros(7, 3), atol=1e-6)


@pytest.mark.parametrize("score", SCORES)
def test_with_more_iterations_the_actors_action_comes_back_but_for_the_clipping_of_saturated_ones(score):
    proposals = th.rand(7, 1, 3) * 2 - 1
    proposals[0], proposals[1] = 1.0, -1.0
    selector = ActorCEM(3, 16, 6, actor_fraction=1.0, actor_std=0.0)
    actions = selector.select(Seen(lambda actions: SCORES[score](actions, proposals)), 7, 3, proposals=proposals).actions
    assert th.allclose(actions, proposals[:, 0], atol=0.0101)


def test_without_proposals_it_is_the_papers_cem():
    score = Seen()
    th.manual_seed(3)
    expected = CEM(3, 20, 4).select(score, 6, 2)
    th.manual_seed(3)
    selection = ActorCEM(3, 20, 4).select(score, 6, 2)
    assert th.equal(selection.actions, expected.actions)
    assert th.equal(selection.elites, expected.elites)
