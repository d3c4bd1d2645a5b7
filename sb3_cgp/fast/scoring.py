"""
Scoring many actions per state by a critic, on which CGP spends three quarters of its training time on a CPU.

Shapes: B states, N actions per state, A action dimensions, F features, H units of a layer.
"""

import functools
from collections.abc import Callable
from typing import Any, TypeGuard

import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_cgp.common.networks import is_hooked
from sb3_cgp.core.cem import Score
from sb3_cgp.core.policies import repeated_q_score
from sb3_cgp.fast.linear import is_linear, leading_relu_layers, multiply

SCORING_DTYPES = ("auto", "float32", "bfloat16")

# Hidden activations of one block, in bytes per thread: about the size of the cache of one core
BLOCK_BYTES = 2**20

# Size in bytes of the block that raises glibc's mmap threshold
MMAP_THRESHOLD = 2**24

# Number of states from which on bfloat16 is faster despite its further operations
MANY_STATES = 8

# Maps hidden activations, (B N, H), to the next ones, and may overwrite them
Layer = Callable[[th.Tensor], th.Tensor]


@functools.cache
def raise_mmap_threshold() -> None:
    """
    Let glibc, where it is the C library, keep freed memory for the next activations, in the whole process.

    glibc returns freed blocks above a threshold to the system, so that the activations of each block of states come from
    fresh pages. The threshold rises to the size of the largest such block freed so far, up to 32 MiB (``man mallopt``).
    The block that is allocated and freed here is never written, so that it occupies no memory. It makes CEM faster in
    bfloat16, and makes no difference in float32.
    """
    th.empty(MMAP_THRESHOLD, dtype=th.uint8)


def scoring_dtype(setting: str, device: th.device) -> th.dtype:
    """
    Return the data type of all layers but the last one while actions are scored.

    :param setting: "float32", "bfloat16", or "auto": bfloat16 where the processor multiplies it faster than float32
    :param device: the device of the critic
    :return: the data type
    """
    if setting == "auto":
        return th.bfloat16 if device.type == "cpu" and _multiplies_bfloat16_faster() else th.float32
    return th.bfloat16 if setting == "bfloat16" else th.float32


def _multiplies_bfloat16_faster() -> bool:
    """Return whether the processor multiplies bfloat16 faster than float32; False where PyTorch does not know it."""
    # Older versions of PyTorch lack this function
    capabilities: dict[str, Any] = getattr(th.cpu, "get_capabilities", dict)()
    # AVX-512 BF16 multiplies no faster on Intel's processors, which have AMX for this. Virtual machines may hide AMX.
    is_intel = "Intel" in capabilities.get("cpu_name", "")
    return bool(capabilities.get("amx_bf16") or (capabilities.get("avx512_bf16") and not is_intel))


def q_score(q_network: nn.Module, features: th.Tensor, dtype: th.dtype = th.float32) -> Score:
    """
    Return the function that scores actions by a Q-network, given the states' features. Both are called without gradients.

    Networks that begin with a linear layer, as all of SB3's do, are scored without repeating the features for
    every action: ``W [s, a] + b = (W_s s + b) + W_a a``, whose first part is computed once per state.

    :param q_network: maps features and actions side by side, (rows, F + A), to values, (rows, 1)
    :param features: the states' features, (B, F)
    :param dtype: data type of the products of all layers but the last one. Everything else is float32. With fewer than
        ``MANY_STATES`` states, one hidden layer, or other layers than linear ones and ReLU, everything is float32.
    :return: the scoring function, (B, N, A) -> (B, N)
    """
    if features.device.type == "cpu":
        raise_mmap_threshold()
    if not _starts_with_linear(q_network):
        return repeated_q_score(q_network, features)
    if dtype != th.float32 and features.shape[0] >= MANY_STATES and _is_relu_network(q_network):
        return _score_by_differences(q_network, features, dtype)
    return _score_by_parts(q_network, features)


def _score_by_parts(q_network: nn.Sequential, features: th.Tensor) -> Score:
    """Return a score whose first layer is split into a part per state and a part per action."""
    first, *following = q_network
    assert isinstance(first, nn.Linear)
    state_part, action_weight = _split(first, features)
    layers = [_prepare(module) for module in following]

    def score(actions: th.Tensor) -> th.Tensor:
        def score_block(block_actions: th.Tensor, block_state_part: th.Tensor) -> th.Tensor:
            hidden = _multiply_each(block_actions, action_weight, block_state_part)
            for layer in layers:
                hidden = layer(hidden)
            return hidden

        return _in_blocks(score_block, first.out_features, actions, state_part)

    return score


def _score_by_differences(q_network: nn.Sequential, features: th.Tensor, dtype: th.dtype) -> Score:
    """
    Return a score by a network of linear layers with ReLU, all of which but the last compute in a data type of 16 bits.

    ``relu(u + d) = relu(u) + max(d + min(u, 0), -relu(u))``, where u is a unit's input for the mean of a state's actions and d
    the difference of its input for one of the actions. The terms in u are computed once per state, in float32. Only the
    differences are rounded, by which CEM ranks, not the part that the actions of a state share, which may be much larger. In
    the first layer u is rounded too: that matters only to units that d turns on or off, where u is the smaller of the two.
    """
    first, *hidden, last = leading_relu_layers(q_network)
    state_part, action_weight = _split(first, features)
    # The first of them multiplies negated differences
    weights = [-hidden[0].weight.to(dtype), *(layer.weight.to(dtype) for layer in hidden[1:])]
    first_weight = action_weight.to(dtype)
    width = max(layer.out_features for layer in (first, *hidden))

    def score(actions: th.Tensor) -> th.Tensor:
        common_actions = actions.mean(dim=1, keepdim=True)
        common = [th.addmm(state_part.squeeze(1), common_actions.squeeze(1), action_weight)]  # (B, H) each
        activations = []
        for layer in hidden:
            activations.append(common[-1].relu())
            common.append(multiply(activations[-1], layer.weight, layer.bias))
        # The last hidden layer in fewer passes: relu(u + d) = u + max(d, -u)
        common_values = F.linear(common[-1], last.weight, last.bias)
        # The first hidden layer negated: min(-d - min(u, 0), relu(u))
        different_actions = (common_actions - actions).to(dtype)
        first_offsets = (activations[0] - common[0]).to(dtype).unsqueeze(1)
        upper_bounds = activations[0].abs().to(dtype).unsqueeze(1)
        offsets = [values.clamp(max=0.0).unsqueeze(1) for values in common[1:-1]]
        lower_bounds = [values.neg().unsqueeze(1) for values in (*activations[1:], common[-1])]

        def score_block(
            block_actions: th.Tensor, addends: th.Tensor, block_upper_bounds: th.Tensor, *of_states: th.Tensor
        ) -> th.Tensor:
            block_offsets, block_lower_bounds = of_states[: len(offsets)], of_states[len(offsets) :]
            rounded = _clip_above(_multiply_each(block_actions, first_weight, addends), block_upper_bounds)
            different = multiply(rounded, weights[0]).to(actions.dtype)
            for weight, block_offset, block_lower_bound in zip(weights[1:], block_offsets, block_lower_bounds, strict=False):
                different.unflatten(0, block_actions.shape[:2]).add_(block_offset)
                different = multiply(_clip_below(different, block_lower_bound).to(dtype), weight).to(actions.dtype)
            return th.mv(_clip_below(different, block_lower_bounds[-1]), last.weight[0])

        values = _in_blocks(score_block, width, different_actions, first_offsets, upper_bounds, *offsets, *lower_bounds)
        return values.add_(common_values)

    return score


def _split(first: nn.Linear, features: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """Split a first layer into the states' part, (B, 1, H), and the weights of the actions' part, (A, H)."""
    n_features = features.shape[1]
    state_part = F.linear(features, first.weight[:, :n_features], first.bias).unsqueeze(1)
    action_weight = first.weight[:, n_features:].t()
    # The copy pays off where it is read more than once
    return state_part, action_weight if features.shape[0] == 1 else action_weight.contiguous()


def _in_blocks(score_block: Callable[..., th.Tensor], width: int, actions: th.Tensor, *of_states: th.Tensor) -> th.Tensor:
    """
    Score the actions of one block of states after the other.

    :param score_block: maps actions, (b, N, A), and tensors of their states, (b, ...), to b N values
    :param width: number of units of the widest layer
    :param actions: the actions, (B, N, A)
    :param of_states: tensors of the states, (B, ...) each
    :return: the values, (B, N)
    """
    n_states, n_actions, _ = actions.shape
    step = n_states
    # On a GPU one large product is the fastest
    if actions.device.type == "cpu":
        # Results may be twice as wide, and shall stay well below the threshold of `raise_mmap_threshold`
        n_bytes = min(BLOCK_BYTES * th.get_num_threads(), MMAP_THRESHOLD // 4)
        step = max(n_bytes // (width * actions.element_size() * n_actions), 1)
    if step >= n_states:
        return score_block(actions, *of_states).view(n_states, n_actions)
    blocks = zip(*(tensor.split(step) for tensor in (actions, *of_states)), strict=True)
    return th.cat([score_block(*block) for block in blocks]).view(n_states, n_actions)


def _multiply_each(actions: th.Tensor, weight: th.Tensor, addends: th.Tensor) -> th.Tensor:
    """Multiply each state's actions, (b, N, A), by weights, (A, H), and add the state's part, (b, 1, H): (b N, H)."""
    if actions.shape[0] == 1:
        return th.addmm(addends[0], actions[0], weight)
    return th.baddbmm(addends, actions, weight.expand(actions.shape[0], -1, -1)).flatten(0, 1)


def _clip_below(hidden: th.Tensor, lower_bounds: th.Tensor) -> th.Tensor:
    """Clip the activations of each state's actions, (b N, H), at the state's lower bounds, (b, 1, H), in place."""
    by_state = hidden.unflatten(0, (lower_bounds.shape[0], -1))
    th.maximum(by_state, lower_bounds, out=by_state)
    return hidden


def _clip_above(hidden: th.Tensor, upper_bounds: th.Tensor) -> th.Tensor:
    """
    Clip 16-bit activations of each state's actions, (b N, H), at the state's non-negative upper bounds, (b, 1, H), in place.

    The numbers are compared as integers, five times as fast as bfloat16, which saves 5 % of a CEM call. Both orders agree
    unless both numbers are negative. So no upper bound may have its sign bit set, not even a negative zero.
    """
    by_state = hidden.view(th.int16).unflatten(0, (upper_bounds.shape[0], -1))
    th.minimum(by_state, upper_bounds.view(th.int16), out=by_state)
    return hidden


def _prepare(module: nn.Module) -> Layer:
    """Return the layer that computes a module after the first."""
    if is_linear(module):
        return functools.partial(multiply, weight=module.weight, bias=module.bias)
    return th.relu_ if type(module) is nn.ReLU else module


def _is_relu_network(q_network: nn.Sequential) -> bool:
    """Return whether a network has only linear layers, at least three, with ReLU between them."""
    n_layers = len(leading_relu_layers(q_network))
    return n_layers > 2 and len(q_network) == 2 * n_layers - 1


def _starts_with_linear(q_network: nn.Module) -> TypeGuard[nn.Sequential]:
    # A subclass of Sequential could compute anything
    if type(q_network) is not nn.Sequential or len(q_network) == 0 or not is_linear(q_network[0]):
        return False
    # Hooks of these modules would not be called; those of modules within them are
    return not any(map(is_hooked, (q_network, *q_network)))
