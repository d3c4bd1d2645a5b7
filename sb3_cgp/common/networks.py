"""Networks: their mode, and their Polyak averages."""

from collections.abc import Iterator
from contextlib import contextmanager

from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor, NatureCNN
from stable_baselines3.common.utils import polyak_update
from stable_baselines3.td3.policies import Actor
from torch import nn

# Modules that compute the same in training and in evaluation mode, and have no running statistics. Subclasses may differ.
MODELESS = frozenset(
    (
        *(Actor, ContinuousCritic, FlattenExtractor, NatureCNN, CombinedExtractor),
        *(nn.Sequential, nn.ModuleList, nn.ModuleDict, nn.Flatten, nn.Linear, nn.Conv2d, nn.LayerNorm),
        *(nn.ReLU, nn.LeakyReLU, nn.ELU, nn.GELU, nn.SiLU, nn.Tanh),
    )
)


def is_hooked(module: nn.Module) -> bool:
    """
    Return whether a module has hooks, so that a call of it does more than its ``forward``.

    :param module: the module
    :return: whether it has hooks
    """
    # PyTorch has no public attribute for this
    return bool(module._forward_hooks or module._forward_pre_hooks or module._backward_hooks or module._backward_pre_hooks)


def has_modes(network: nn.Module) -> bool:
    """
    Return whether a network may compute something else in training mode than in evaluation mode.

    To find that it does not takes a fraction of the time of setting the mode, which visits all modules as well.

    :param network: the network
    :return: False if all of its modules are known to compute the same in both modes, and neither have hooks, buffers nor a
        ``forward`` of their own
    """
    modules = [network]
    for module in modules:
        if type(module) not in MODELESS or is_hooked(module) or module._buffers or "forward" in vars(module):
            return True
        # `Module.children` and `Module.modules` take several times as long
        modules.extend(module._modules.values())  # type: ignore[arg-type]
    return False


def set_mode(network: nn.Module, is_training: bool) -> None:
    """
    Put a network into training or evaluation mode, and its submodules, too, if that makes a difference.

    :param network: the network
    :param is_training: whether into training mode
    """
    if not has_modes(network):
        network.training = is_training
    elif any(module.training != is_training for module in network.modules()):
        network.train(is_training)


@contextmanager
def evaluation_mode(network: nn.Module) -> Iterator[None]:
    """
    Put a network into evaluation mode within a ``with`` block.

    Neither dropout nor batch statistics disturb it then, and its running statistics do not change.

    :param network: the network. One without modes is left as it is. A submodule that alone was in training mode is left in
        evaluation mode.
    """
    if not has_modes(network):
        yield
        return
    was_training = network.training
    set_mode(network, False)
    try:
        yield
    finally:
        if was_training:
            set_mode(network, True)


def update_average(network: nn.Module, average: nn.Module, tau: float) -> None:
    """
    Move a Polyak average towards its network, and copy batch norm's running statistics (SB3 issue #996).

    :param network: the network
    :param average: its average
    :param tau: the coefficient of the update, from 0 to 1
    """
    polyak_update(network.parameters(), average.parameters(), tau)
    if has_modes(network):
        # Three times as fast as `stable_baselines3.common.utils.get_parameters_by_name`
        statistics, averaged = ([x for name, x in each.named_buffers() if "running_" in name] for each in (network, average))
        polyak_update(statistics, averaged, 1.0)
