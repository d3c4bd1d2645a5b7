"""MPPI: against a loop, from the actor's action and from the prior's samples alone, and its temperature."""

import math

import numpy as np
import pytest
import torch as th
from scores import first_pairs

from sb3_cgp import CEM
from sb3_cgp.selectors import MPPI, ActorStart
from sb3_cgp.selectors.proposals import takes_proposals


def oracle_mppi(value, unknown, pairs, draws, n_elites, temperature):
    """
    MPPI for one state of one dimension, a loop for every line of it; values below ``unknown`` are NaN.

    :return: the best action of the last iteration, the weighted mean's, and the last elites of known values, before tanh
    """
    mean, std = 0.0, 1.0
    for iteration in range(len(draws)):
        if iteration > 0:
            pairs = [(mean + std * draw, math.tanh(mean + std * draw)) for draw in draws[iteration]]
        samples, values = [sample for sample, _ in pairs], [value(action) for _, action in pairs]
        known = [index for index in range(len(pairs)) if values[index] >= unknown]
        scale = np.std([values[index] for index in known]) * temperature
        best = sorted(known, key=lambda index: values[index], reverse=True)[:n_elites]
        weights = [math.exp((values[index] - values[best[0]]) / scale) for index in best]
        total = sum(weights)
        mean = sum(weight * samples[index] for weight, index in zip(weights, best, strict=True)) / total
        variance = sum(weight * (samples[index] - mean) ** 2 for weight, index in zip(weights, best, strict=True)) / total
        std = math.sqrt(variance)
    return pairs[best[0]][1], math.tanh(mean), [samples[index] for index in best]


@pytest.mark.parametrize("result", ["best", "mean"])
@pytest.mark.parametrize("iterations", [1, 3])
@pytest.mark.parametrize("start", [None, ActorStart(0.4, 0.1)], ids=["prior", "actor"])
@pytest.mark.parametrize("unknown", [-math.inf, -49.0, 0.0, 10.0], ids=lambda below: f"NaN below {below}")
def test_mppi_is_a_loop_for_every_line_of_it(unknown, start, iterations, result):
    """Also where some values are NaN: few of them, half, or so many that elites are among them."""
    proposals = th.tensor([0.2, -0.5, 1.0]).view(3, 1, 1)
    th.manual_seed(2)
    draws = [th.randn(3, 10, 1) for _ in range(iterations)]

    def score(actions):
        values = (9 * actions).sin().squeeze(2) * 50
        return values.where(values >= unknown, math.nan)

    th.manual_seed(2)
    selection = MPPI(iterations, 10, 4, result, 0.7, start).select(score, 3, 1, proposals=proposals)
    for state in range(3):
        of_state = [draw[state, :, 0].tolist() for draw in draws]
        pairs = [(draw, math.tanh(draw)) for draw in of_state[0]]
        if start is not None:
            pairs = first_pairs(of_state[0], proposals[state].item(), 4, 0.1)
        best, mean, elites = oracle_mppi(lambda action: 50 * math.sin(9 * action), unknown, pairs, of_state, 4, 0.7)
        assert selection.actions[state].item() == pytest.approx(best if result == "best" else mean, abs=1e-4)
        assert selection.elites[state, : len(elites), 0].tolist() == pytest.approx(elites, abs=1e-4)


def test_mppi_takes_proposals_where_it_starts_from_the_actor():
    assert takes_proposals(MPPI(start=ActorStart()))
    assert not takes_proposals(MPPI())


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


@pytest.mark.parametrize("value", [0.0, 3.0, math.nan, math.inf])
def test_mppi_weighs_all_alike_where_values_tell_nothing(value):
    selection = MPPI(2, 8, 3).select(lambda actions: th.full(actions.shape[:2], value), 4, 2)
    assert selection.actions.isfinite().all()
    assert selection.elites.isfinite().all()


@pytest.mark.parametrize("unknown", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("known", [0.0, 3.0], ids=["zero", "equal"])
def test_mppi_gives_no_weight_to_values_that_are_not_finite_beside_equal_ones(known, unknown):
    """All finite values are equal, so that their standard deviation is 0. Three values rank first where they are infinite."""
    th.manual_seed(0)
    expected = th.randn(1, 8, 1)[:, :2].mean(dim=1).tanh()
    th.manual_seed(0)
    values = th.tensor([[known] * 2 + [unknown] * 3 + [math.nan] * 3])
    assert th.allclose(MPPI(1, 8, 5).select(lambda actions: values, 1, 1).actions, expected)
