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

from sb3_cgp.core.cem import Score
from sb3_cgp.fast.linear import is_hooked, is_linear, multiply, rectified_layers
from sb3_cgp.fast.mlp import Perceptron

# Hidden activations of one block, in bytes for each thread: about what stays in the cache near a core
BLOCK_BYTES = 2**20

# Bytes of a block of memory that makes the C library keep what is freed
KEPT_MEMORY = 2**24

# From which on another data type makes up for the operations that it adds
MANY_STATES = 8

# Maps hidden activations, (B N, H), to the next ones, and may overwrite them
Layer = Callable[[th.Tensor], th.Tensor]


@functools.cache
def _keep_freed_memory() -> None:
    """
    Have glibc, where it is the C library, keep freed memory for the next activations.

    It hands blocks beyond a threshold back to the system, which costs more than a pass over them, as fresh memory comes a
    page at a time. The threshold is the size of the largest such block freed so far, up to 32 MiB (see ``man mallopt``).
    The block for that is never written, so that it takes no memory.
    """
    th.empty(KEPT_MEMORY, dtype=th.uint8)


def scoring_dtype(setting: str, device: th.device) -> th.dtype:
    """
    Tell which data type all layers but the last compute in while actions are scored.

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
    Make the function that scores actions by a Q-network, given the states' features. Both are called without gradients.

    Networks that begin with a linear layer, as all of SB3's do, are scored without repeating the features for
    every action: ``W [s, a] + b = (W_s s + b) + W_a a``, whose first part is computed once per state.

    :param q_network: maps features and actions side by side, (rows, F + A), to values, (rows, 1)
    :param features: the states' features, (B, F)
    :param dtype: data type of all layers' products but the last one's, which bfloat16 may make faster. Everything else is
        float32, and so is all where states are few, or where a network has other layers than linear ones and rectifiers
        between them.
    :return: the scoring function, (B, N, A) -> (B, N)
    """
    if features.device.type == "cpu":
        _keep_freed_memory()
    if not _begins_with_linear(q_network):
        return repeated_q_score(q_network, features)
    if dtype != th.float32 and features.shape[0] >= MANY_STATES and _is_rectifier_network(q_network):
        return _score_by_differences(q_network, features, dtype)
    return _score_by_parts(q_network, features)


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


def _score_by_parts(q_network: nn.Sequential, features: th.Tensor) -> Score:
    """Score with the first layer split into a part per state and a part per action."""
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
    Score by a network of linear layers and rectifiers, all of which but the last compute in a data type of 16 bits.

    ``relu(u + d) = relu(u) + max(d + min(u, 0), -relu(u))``, where u is what a unit has for the mean of a state's actions,
    and d by how much it differs for one of them. What follows from u is computed once per state, in float32. Only
    differences are rounded, which CEM ranks, and not what a state's actions have in common, which may be much larger. In the
    first layer u is rounded, too: that matters only to units that d turns on or off, where u is the smaller of the two.
    """
    first, *hidden, last = rectified_layers(q_network)
    state_part, action_weight = _split(first, features)
    # The first of them is given differences with their signs turned
    weights = [-hidden[0].weight.to(dtype), *(layer.weight.to(dtype) for layer in hidden[1:])]
    first_weight = action_weight.to(dtype).expand(features.shape[0], -1, -1)
    width = max(layer.out_features for layer in (first, *hidden))

    def score(actions: th.Tensor) -> th.Tensor:
        common_actions = actions.mean(dim=1, keepdim=True)
        common = [th.addmm(state_part.squeeze(1), common_actions.squeeze(1), action_weight)]  # (B, H) each
        rectified = []
        for layer in hidden:
            rectified.append(common[-1].relu())
            common.append(multiply(rectified[-1], layer.weight, layer.bias))
        # The last hidden layer in fewer passes: relu(u + d) = u + max(d, -u)
        common_values = F.linear(common[-1], last.weight, last.bias)
        # The first one with its sign turned, min(-d - min(u, 0), relu(u)), whose first part is one product
        different_actions = F.pad((common_actions - actions).to(dtype), (0, 1), value=1.0)  # (B, N, A + 1)
        first_offsets = (rectified[0] - common[0]).to(dtype).unsqueeze(1)
        first_weights = th.cat([first_weight, first_offsets], dim=1)  # (B, A + 1, H)
        ceilings = rectified[0].abs().to(dtype).unsqueeze(1)
        offsets = [values.clamp(max=0.0).unsqueeze(1) for values in common[1:-1]]
        floors = [values.neg().unsqueeze(1) for values in (*rectified[1:], common[-1])]

        def score_block(
            block_actions: th.Tensor, block_weights: th.Tensor, block_ceilings: th.Tensor, *of_states: th.Tensor
        ) -> th.Tensor:
            block_offsets, block_floors = of_states[: len(offsets)], of_states[len(offsets) :]
            rounded = _lower_each(th.bmm(block_actions, block_weights), block_ceilings).flatten(0, 1)
            different = multiply(rounded, weights[0]).to(actions.dtype)
            for weight, block_offset, block_floor in zip(weights[1:], block_offsets, block_floors, strict=False):
                different.unflatten(0, block_actions.shape[:2]).add_(block_offset)
                different = multiply(_raise_each(different, block_floor).to(dtype), weight).to(actions.dtype)
            return th.mv(_raise_each(different, block_floors[-1]), last.weight[0])

        values = _in_blocks(score_block, width, different_actions, first_weights, ceilings, *offsets, *floors)
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
    Score a block of states at a time.

    :param score_block: actions (b, N, A), and what belongs to their states -> their values, b N in all
    :param width: units of the widest layer
    :param actions: the actions, (B, N, A)
    :param of_states: what belongs to the states, (B, ...) each
    :return: the values, (B, N)
    """
    n_states, n_actions, _ = actions.shape
    step = n_states
    # Only a CPU gains from blocks: on a GPU one large product is the fastest
    if actions.device.type == "cpu":
        # Results may be twice as wide, and are to stay well within the memory that is kept
        n_bytes = min(BLOCK_BYTES * th.get_num_threads(), KEPT_MEMORY // 4)
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


def _raise_each(hidden: th.Tensor, floors: th.Tensor) -> th.Tensor:
    """Raise the activations of each state's actions, (b N, H), to the state's floors, (b, 1, H), in place."""
    by_state = hidden.unflatten(0, (floors.shape[0], -1))
    th.maximum(by_state, floors, out=by_state)
    return hidden


def _lower_each(hidden: th.Tensor, ceilings: th.Tensor) -> th.Tensor:
    """
    Lower activations of 16 bits, (b, N, H), to ceilings that are not negative, (b, 1, H), in place.

    As integers, which are compared five times as fast. Their order is that of the numbers wherever one of the two is not
    negative; only the order among negative numbers is the reverse. So no ceiling may have its sign bit set, not even zero.
    """
    integers = hidden.view(th.int16)
    th.minimum(integers, ceilings.view(th.int16), out=integers)
    return hidden


def _prepare(module: nn.Module) -> Layer:
    """Turn a module after the first into a layer."""
    if is_linear(module):
        return functools.partial(multiply, weight=module.weight, bias=module.bias)
    return th.relu_ if type(module) is nn.ReLU else module


def _is_rectifier_network(q_network: nn.Sequential) -> bool:
    """Whether a network has linear layers alone, at least three, and rectifiers between them."""
    n_layers = len(rectified_layers(q_network))
    return n_layers > 2 and len(q_network) == 2 * n_layers - 1


def _begins_with_linear(q_network: nn.Module) -> TypeGuard[nn.Sequential]:
    if not isinstance(q_network, nn.Sequential) or type(q_network) not in (nn.Sequential, Perceptron):
        return False
    if len(q_network) == 0 or not is_linear(q_network[0]):
        return False
    # A hook may do anything; those of modules within these still run
    return not any(map(is_hooked, (q_network, *q_network)))
