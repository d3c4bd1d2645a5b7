"""
How a critic scores many actions per state.

Shapes: B states, N actions per state, A action dimensions, F features, H units of a layer.
"""

import functools
from collections.abc import Callable
from typing import Any, TypeGuard

import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_cgp.cem import Score

# Hidden activations of one block, per thread: about what stays in a core's cache (1 MiB of float32)
BLOCK_SIZE = 2**18

# Maps hidden activations, (B N, H), given N, to the next ones, and may overwrite them
Layer = Callable[[th.Tensor, int], th.Tensor]


@functools.cache
def _onednn_linear(dtype: th.dtype) -> Callable[..., th.Tensor] | None:
    """
    Find oneDNN's linear layer with a rectifier fused to it, which PyTorch's compiler uses and keeps private.

    The public one asks MKL for float32, which is at half oneDNN's speed on AMD's processors, and does not fuse.

    :param dtype: the data type
    :return: the function; None where there is none, or none for this processor
    """
    linear = getattr(th.ops.mkldnn, "_linear_pointwise", None) if th.backends.mkldnn.is_available() else None
    if linear is not None:
        try:
            linear(th.ones(1, 1, dtype=dtype), th.ones(1, 1, dtype=dtype), None, "relu", [], "")
        except RuntimeError:
            return None
    return linear


def scoring_dtype(setting: str, device: th.device) -> th.dtype:
    """
    Tell which data type hidden layers compute in while actions are scored.

    :param setting: "float32", "bfloat16", or "auto": bfloat16 where the processor multiplies it natively
    :param device: the device of the critic
    :return: the data type
    """
    if setting == "auto":
        return th.bfloat16 if device.type == "cpu" and _has_native_bfloat16() else th.float32
    return th.bfloat16 if setting == "bfloat16" else th.float32


def _has_native_bfloat16() -> bool:
    # Older versions of PyTorch cannot be asked: float32 is never wrong
    capabilities: dict[str, Any] = getattr(th.cpu, "get_capabilities", dict)()
    return bool(capabilities.get("avx512_bf16") or capabilities.get("amx_bf16"))


def q_score(q_network: nn.Module, features: th.Tensor, dtype: th.dtype = th.float32) -> Score:
    """
    Make the function that scores actions by a Q-network, given the states' features.

    Networks that begin with a linear layer, as all of SB3's do, are scored without repeating the features for
    every action: ``W [s, a] + b = (W_s s + b) + W_a a``, whose first part is computed once per state.

    :param q_network: maps features and actions side by side, (rows, F + A), to values, (rows, 1)
    :param features: the states' features, (B, F)
    :param dtype: data type of the hidden layers' products, which bfloat16 may make faster. Everything else is float32,
        and so is all of a network that has layers with parameters that are not linear.
    :return: the scoring function, (B, N, A) -> (B, N), without gradients
    """
    if _begins_with_linear(q_network):
        return _score_by_parts(q_network, features, dtype)
    return repeated_q_score(q_network, features)


def repeated_q_score(q_network: nn.Module, features: th.Tensor) -> Score:
    """
    Make the same scoring function for any Q-network, by repeating the features for every action.

    :param q_network: maps features and actions side by side, (rows, F + A), to values, (rows, 1)
    :param features: the states' features, (B, F)
    :return: the scoring function, (B, N, A) -> (B, N)
    """

    def score(actions: th.Tensor) -> th.Tensor:
        repeated = features.unsqueeze(1).expand(-1, actions.shape[1], -1)
        return q_network(th.cat([repeated, actions], dim=2).flatten(0, 1)).view(actions.shape[:2])

    return score


def _score_by_parts(q_network: nn.Sequential, features: th.Tensor, dtype: th.dtype) -> Score:
    """Score with the first layer split into a part per state and a part per action, a block of states at a time."""
    first, *following = q_network
    assert isinstance(first, nn.Linear)
    weight, n_features, width = first.weight, features.shape[1], first.out_features
    state_part = F.linear(features, weight[:, :n_features], first.bias).unsqueeze(1)  # (B, 1, H)
    action_weight = weight[:, n_features:].t().contiguous()  # (A, H)
    layers = _prepare(following, dtype)

    @th.no_grad()
    def score(actions: th.Tensor) -> th.Tensor:
        n_states, n_actions, _ = actions.shape
        values = actions.new_empty(n_states, n_actions)
        # Only a CPU gains from blocks: on a GPU one large product is the fastest
        rows = BLOCK_SIZE * th.get_num_threads() // width if actions.device.type == "cpu" else n_states * n_actions
        step = max(rows // n_actions, 1)
        for start in range(0, n_states, step):
            block = slice(start, start + step)
            block_actions = actions[block]
            weights = action_weight.expand(len(block_actions), -1, -1)
            hidden = th.baddbmm(state_part[block], block_actions, weights).flatten(0, 1)
            for layer in layers:
                hidden = layer(hidden, n_actions)
            values[block] = hidden.view(-1, n_actions)
        return values

    return score


def _prepare(modules: list[nn.Module], dtype: th.dtype) -> list[Layer]:
    """Turn the modules after the first into layers."""
    hidden_dtype = dtype if all(_is_linear(module) or _is_bare(module) for module in modules) else th.float32
    last = max((index for index, module in enumerate(modules) if _is_linear(module)), default=None)
    layers: list[Layer] = []
    is_fused = False
    for index, module in enumerate(modules):
        if _is_linear(module):
            is_fused = index != last and type(modules[index + 1]) is nn.ReLU
            layers.append(_last_linear(module) if index == last else _hidden_linear(module, hidden_dtype, is_fused))
        elif is_fused:
            is_fused = False
        else:
            layers.append(_activation(module))
    return layers


def _begins_with_linear(q_network: nn.Module) -> TypeGuard[nn.Sequential]:
    if type(q_network) is not nn.Sequential or len(q_network) == 0 or not _is_linear(q_network[0]):
        return False
    # A hook may do anything
    return not any(map(_is_hooked, q_network.modules()))


def _is_linear(module: nn.Module) -> TypeGuard[nn.Linear]:
    # A subclass may do anything
    return type(module) is nn.Linear


def _is_hooked(module: nn.Module) -> bool:
    # PyTorch has no public way to ask
    return bool(module._forward_hooks or module._forward_pre_hooks)


def _is_bare(module: nn.Module) -> bool:
    """Whether a module has neither parameters nor buffers, as activations have none: it works in any data type."""
    return next(module.parameters(), None) is None and next(module.buffers(), None) is None


def _activation(module: nn.Module) -> Layer:
    if type(module) is nn.ReLU:
        return lambda hidden, n_actions: hidden.relu_()
    return lambda hidden, n_actions: module(hidden)


def _hidden_linear(linear: nn.Linear, dtype: th.dtype, is_rectified: bool) -> Layer:
    """Make a hidden linear layer and its rectifier."""
    if dtype != th.float32:
        return _rounded_linear(linear, dtype, is_rectified)
    return lambda hidden, n_actions: _multiply(hidden, linear.weight, linear.bias, is_rectified)


def _rounded_linear(linear: nn.Linear, dtype: th.dtype, is_rectified: bool) -> Layer:
    """
    Make a hidden linear layer that multiplies in another data type, and its rectifier.

    ``W x + b = (W r + b) + W (x - r)``, where r is a state's mean input: only the differences between its actions are rounded,
    which CEM ranks, and not what its actions have in common, which may be much larger.
    """
    weight = linear.weight.to(dtype)

    def layer(hidden: th.Tensor, n_actions: int) -> th.Tensor:
        inputs = hidden.unflatten(0, (-1, n_actions))
        common = inputs.mean(dim=1, keepdim=True)
        differences = inputs.sub_(common).flatten(0, 1).to(dtype)
        outputs = _multiply(differences, weight).to(hidden.dtype)
        outputs.unflatten(0, (-1, n_actions)).add_(_multiply(common.squeeze(1), linear.weight, linear.bias).unsqueeze(1))
        return outputs.relu_() if is_rectified else outputs

    return layer


def _multiply(hidden: th.Tensor, weight: th.Tensor, bias: th.Tensor | None = None, is_rectified: bool = False) -> th.Tensor:
    onednn_linear = _onednn_linear(hidden.dtype) if hidden.device.type == "cpu" else None
    if onednn_linear is not None:
        return onednn_linear(hidden, weight, bias, "relu" if is_rectified else "none", [], "")
    product = F.linear(hidden, weight, bias)
    return product.relu_() if is_rectified else product


def _last_linear(linear: nn.Linear) -> Layer:
    return lambda hidden, n_actions: F.linear(hidden, linear.weight, linear.bias)
