"""Networks: their mode, and their Polyak averages."""

from collections.abc import Iterator
from contextlib import contextmanager

from stable_baselines3.common.utils import polyak_update
from torch import nn


@contextmanager
def evaluation_mode(network: nn.Module) -> Iterator[None]:
    """
    Put a network into evaluation mode within a ``with`` block.

    Neither dropout nor batch statistics disturb it then, and its running statistics do not change.

    :param network: the network. A submodule that alone was in training mode is left in evaluation mode.
    """
    was_training = network.training
    if any(module.training for module in network.modules()):
        network.eval()
    try:
        yield
    finally:
        if was_training:
            network.train()


def update_average(network: nn.Module, average: nn.Module, tau: float) -> None:
    """
    Move a Polyak average towards its network, and copy batch norm's running statistics (SB3 issue #996).

    :param network: the network
    :param average: its average
    :param tau: the coefficient of the update, from 0 to 1
    """
    polyak_update(network.parameters(), average.parameters(), tau)
    # Three times as fast as `stable_baselines3.common.utils.get_parameters_by_name`
    statistics, averaged = ([x for name, x in each.named_buffers() if "running_" in name] for each in (network, average))
    polyak_update(statistics, averaged, 1.0)
