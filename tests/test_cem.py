"""CEM against a plain transcription of Algorithm 1, and on functions whose maximum is known."""

import oracles
import pytest
import torch as th

from sb3_cgp import CEM
from sb3_cgp.core.cem import find_elites


def quadratic(peak: th.Tensor):
    """Scores actions by their squared distance to a peak per state, (B, A)."""
    return lambda actions: -(actions - peak.unsqueeze(1)).square().sum(dim=2)


@pytest.mark.parametrize(("iterations", "samples", "elites"), [(2, 64, 6), (4, 16, 1), (1, 5, 5), (3, 1, 1), (2, 10, 10)])
@pytest.mark.parametrize("action_dim", [1, 3])
def test_agrees_with_algorithm_1_given_the_same_draws(iterations, samples, elites, action_dim):
    n_states = 4
    # A bumpy score, so that neither the mean nor a linear map would do
    weights = th.randn(n_states, action_dim, generator=th.Generator().manual_seed(1))

    def score(actions):
        return (3 * actions * weights.unsqueeze(1)).sin().sum(dim=2)

    th.manual_seed(0)
    selection = CEM(iterations, samples, elites).select(score, n_states, action_dim)
    actions, std_found = selection.actions, selection.std
    th.manual_seed(0)
    mean_actions = CEM(iterations, samples, elites, result="mean").select(score, n_states, action_dim).actions
    th.manual_seed(0)
    draws = [th.randn(n_states, samples, action_dim) for _ in range(iterations)]

    for state in range(n_states):

        def score_one(action, state=state):
            return score(th.tensor(action).expand(n_states, 1, action_dim))[state, 0].item()

        best, mean, std = oracles.cem(score_one, [draw[state].tolist() for draw in draws], elites)
        assert actions[state].tolist() == pytest.approx(best, abs=1e-5)
        assert std_found[state].tolist() == pytest.approx(std, abs=1e-4)
        assert mean_actions[state].tolist() == pytest.approx(th.tensor(mean).tanh().tolist(), abs=1e-4)


@pytest.mark.parametrize("result", ["best", "mean"])
def test_converges_to_a_known_maximum(result):
    th.manual_seed(0)
    peak = th.tensor([[0.5, -0.8], [0.0, 0.3], [-0.9, 0.9]])
    errors = []
    for iterations in (2, 5, 10, 20):
        actions = CEM(iterations, samples=200, elites=20, result=result).select(quadratic(peak), 3, 2).actions
        errors.append((actions - peak).abs().max().item())
    # Each refit narrows the distribution, so that the error falls geometrically until float32 ends it
    assert errors[0] < 0.2
    assert errors[-1] < 1e-3
    assert errors[-1] < errors[0] / 10


def test_finds_the_best_of_many_samples_as_closely_as_theory_says():
    # One iteration keeps the sample closest to the peak at 0. Of n draws a of N(0, 1) the smallest |tanh(a)| is about
    # exponentially distributed with mean sqrt(pi / 2) / n
    th.manual_seed(0)
    n_states, samples = 4_000, 100
    actions = CEM(1, samples, 1).select(quadratic(th.zeros(n_states, 1)), n_states, 1).actions
    expected = (th.pi / 2) ** 0.5 / samples
    standard_error = expected / n_states**0.5
    assert actions.abs().mean().item() == pytest.approx(expected, abs=5 * standard_error)


def test_reaches_maxima_on_the_boundary():
    th.manual_seed(0)
    # Before tanh, refits to the top tenth move the mean by 1.75 standard deviations and shrink these to 0.4 of their
    # size each time: to 1.75 / 0.6 = 2.9 in all
    actions = CEM(10, 64, 6).select(lambda actions: actions.sum(dim=2), 50, 1).actions
    assert actions.mean().item() == pytest.approx(0.994, abs=0.01)
    assert th.all(actions <= 1.0)


def test_the_winner_was_scored_and_is_the_best_of_the_last_iteration():
    th.manual_seed(0)
    seen = []

    def score(actions):
        values = actions.sin().sum(dim=2)
        seen.append((actions, values))
        return values

    actions = CEM(3, 20, 4).select(score, 6, 2).actions
    assert len(seen) == 3
    last_actions, last_values = seen[-1]
    assert th.equal(actions, last_actions[th.arange(6), last_values.argmax(dim=1)])


def test_one_elite_collapses_the_distribution():
    th.manual_seed(0)
    selection = CEM(2, 50, 1).select(quadratic(th.full((3, 1), 0.2)), 3, 1)
    assert th.equal(selection.std, th.zeros(3, 1))
    assert th.all((selection.actions - 0.2).abs() < 0.2)


def test_nan_is_never_an_elite():
    th.manual_seed(0)

    def score(actions):
        values = -(actions[:, :, 0] + 0.5).square()
        # Everything above zero is poisoned: a NaN that sorted highest would win
        return values.masked_fill(actions[:, :, 0] > 0, th.nan)

    selection = CEM(5, 64, 6).select(score, 8, 1)
    actions = selection.actions
    assert th.all(actions < 0)
    assert th.all(selection.std.isfinite())
    assert actions.flatten().tolist() == pytest.approx([-0.5] * 8, abs=0.05)


@pytest.mark.parametrize("n_elites", [1, 2, 3, 4])
def test_nan_ranks_below_every_number(n_elites):
    values = th.tensor([[th.nan, -th.inf, 1.0, th.inf], [-th.inf, 2.0, th.nan, -3.0]])
    assert find_elites(values, n_elites)[..., 0].tolist() == [[3, 2, 1, 0][:n_elites], [1, 3, 0, 2][:n_elites]]


@pytest.mark.parametrize(
    ("name", "value"), [("iterations", 0), ("samples", -1), ("elites", 0), ("elites", 65), ("samples", 1.5)]
)
def test_refuses_impossible_counts(name, value):
    with pytest.raises(ValueError, match=f"`{name}` is {value}"):
        CEM(**{name: value})


def test_refuses_an_unknown_result():
    with pytest.raises(ValueError, match="`result` is 'worst', but must be one of 'best', 'mean'"):
        CEM(result="worst")
