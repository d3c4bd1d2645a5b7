"""Losses that are NaN or infinite are refused before the optimizer step."""

import pytest
import torch as th
from guarded import SMALL, located
from stable_baselines3 import TD3

from sb3_cgp.guards.losses import LossGuard


class Descending(TD3):
    """Counts the steps down its losses."""

    n_steps_down = 0

    def train(self, gradient_steps, batch_size=100):
        for loss in self.losses:
            self._n_updates += 1
            self._check_loss("critic", th.tensor(loss, requires_grad=True))
            self.n_steps_down += 1


class Guarded(LossGuard, Descending):
    pass


@pytest.mark.parametrize("loss", [float("nan"), float("inf"), -float("inf")])
def test_a_loss_that_is_no_number_is_refused_before_the_step(loss):
    model = Guarded("MlpPolicy", located(), **SMALL)
    model.losses = [1.0, -2.0, loss, 3.0]
    with pytest.raises(
        ValueError, match=rf"The critic loss is {loss} at gradient step 3, environment step 7\. The critic is as"
    ):
        model.learn(20)
    assert model.n_steps_down == 2
