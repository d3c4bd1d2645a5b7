"""CEM from the actor's action: its search, against a loop and on two maxima."""

import math

import pytest
import torch as th
from scores import first_pairs

from sb3_cgp.selectors import ActorCEM


def oracle_actor_cem(score, draws, n_elites, proposal, n_around, std):
    """CEM from the actor for one state of one dimension, a loop for every line: the best action of all samples, and elites."""
    pairs = first_pairs(draws[0], proposal, n_around, std)
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


@pytest.mark.parametrize("result", ["best", "mean"])
@pytest.mark.parametrize("iterations", [1, 2, 4])
def test_is_a_loop_for_every_line_of_it(iterations, result):
    def score(action):
        return math.sin(9 * action) - action**2

    proposals = th.tensor([-0.6, 0.3, 0.999, -1.0]).view(4, 1, 1)
    th.manual_seed(1)
    draws = [th.randn(4, 12, 1) for _ in range(iterations)]
    th.manual_seed(1)
    selection = ActorCEM(iterations, 12, 3, result, actor_fraction=0.4, actor_std=0.1).select(
        lambda actions: (9 * actions).sin().sub(actions.square()).squeeze(2), 4, 1, proposals=proposals
    )
    for state in range(4):
        of_state = [draw[state, :, 0].tolist() for draw in draws]
        best, elites = oracle_actor_cem(score, of_state, 3, proposals[state].item(), 5, 0.1)
        action = best if result == "best" else math.tanh(sum(elites) / 3)
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

        # Whoever found it in the first of three iterations, whose samples are the same, still has it after the last
        th.manual_seed(0)
        thrice = ActorCEM(3, n_samples, 6, actor_fraction=fraction, actor_std=0.05)
        later = thrice.select(two_maxima, n_states, 1, proposals=th.full((n_states, 1, 1), -0.5)).actions
        assert (later > 0)[actions > 0].all()


def test_nan_ranks_last():
    proposals = th.tensor([[[0.2]], [[0.4]]])

    def score(actions):
        values = -actions.square().squeeze(2)
        values[0, 0] = th.nan
        return values

    selection = ActorCEM(1, 8, 2).select(score, 2, 1, proposals=proposals)
    assert selection.actions[0] != proposals[0, 0]
    assert selection.actions.isfinite().all()
