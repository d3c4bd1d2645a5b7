"""MPPI: against a loop, and its temperature."""

import math

import numpy as np
import pytest
import torch as th

from sb3_cgp import CEM
from sb3_cgp.selectors import MPPI


@pytest.mark.parametrize("unknown", [-math.inf, -49.0, 0.0, 10.0], ids=lambda below: f"NaN below {below}")
def test_mppi_is_a_loop_for_every_line_of_it(unknown):
    """Also where some values are NaN: few of them, half, or so many that elites are among them."""
    temperature, n_elites = 0.7, 4
    th.manual_seed(2)
    draws = [th.randn(3, 10, 1) for _ in range(3)]

    def score(actions):
        values = (9 * actions).sin().squeeze(2) * 50
        return values.where(values >= unknown, math.nan)

    th.manual_seed(2)
    selection = MPPI(3, 10, n_elites, "mean", temperature).select(score, 3, 1)
    for state in range(3):
        mean, std = 0.0, 1.0
        for iteration in draws:
            samples = [mean + std * draw for draw in iteration[state, :, 0].tolist()]
            values = [50 * math.sin(9 * math.tanh(sample)) for sample in samples]
            scale = np.std([value for value in values if value >= unknown]) * temperature
            known = [index for index in range(10) if values[index] >= unknown]
            best = sorted(known, key=lambda index: values[index], reverse=True)[:n_elites]
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


@pytest.mark.parametrize("value", [0.0, 3.0, math.nan, math.inf])
def test_mppi_weighs_all_alike_where_values_tell_nothing(value):
    selection = MPPI(2, 8, 3).select(lambda actions: th.full(actions.shape[:2], value), 4, 2)
    assert selection.actions.isfinite().all()
    assert selection.elites.isfinite().all()


@pytest.mark.parametrize("further", [0.0, 3.0], ids=["zero", "equal"])
def test_mppi_gives_no_weight_to_unknown_values_beside_equal_ones(further):
    """All known values are equal, so that their standard deviation is 0."""
    th.manual_seed(0)
    expected = th.randn(1, 8, 1)[:, :2].mean(dim=1).tanh()
    th.manual_seed(0)
    values = th.tensor([[further] * 2 + [math.nan] * 6])
    assert th.allclose(MPPI(1, 8, 5).select(lambda actions: values, 1, 1).actions, expected)
