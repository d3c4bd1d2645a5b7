"""
How a critic scores many actions per state.

Shapes: B states, N actions per state, A action dimensions, F features, H units of the first layer.
"""

import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_cgp.cem import Score

# Hidden activations of one block, per thread: about what stays in a core's cache (1 MiB of float32)
BLOCK_SIZE = 2**18


def q_score(q_network: nn.Module, features: th.Tensor) -> Score:
    """
    Make the function that scores actions by a Q-network, given the states' features.

    Networks that begin with a linear layer, as all of SB3's do, are scored without repeating the features for
    every action: ``W [s, a] + b = (W_s s + b) + W_a a``, whose first part is computed once per state.

    :param q_network: maps features and actions side by side, (rows, F + A), to values, (rows, 1)
    :param features: the states' features, (B, F)
    :return: the scoring function, (B, N, A) -> (B, N)
    """
    if isinstance(q_network, nn.Sequential) and len(q_network) > 0 and type(q_network[0]) is nn.Linear:
        return _score_by_parts(q_network, features)
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


def _score_by_parts(q_network: nn.Sequential, features: th.Tensor) -> Score:
    """Score with the first layer split into a part per state and a part per action, a block of states at a time."""
    first, *following = q_network
    assert isinstance(first, nn.Linear)
    weight, n_features, width = first.weight, features.shape[1], first.out_features
    state_part = F.linear(features, weight[:, :n_features], first.bias).unsqueeze(1)  # (B, 1, H)
    action_weight = weight[:, n_features:].t()  # (A, H)

    def score(actions: th.Tensor) -> th.Tensor:
        n_states, n_actions, _ = actions.shape
        values = actions.new_empty(n_states, n_actions)
        # Only a CPU gains from blocks: on a GPU one large product is the fastest
        rows = BLOCK_SIZE * th.get_num_threads() // width if actions.device.type == "cpu" else n_states * n_actions
        step = max(rows // n_actions, 1)
        for start in range(0, n_states, step):
            block = slice(start, start + step)
            hidden = th.matmul(actions[block], action_weight).add_(state_part[block]).flatten(0, 1)
            for layer in following:
                # Every hidden tensor is ours, so that the rectifier can spare a copy
                hidden = hidden.relu_() if type(layer) is nn.ReLU else layer(hidden)
            values[block] = hidden.reshape(-1, n_actions)
        return values

    return score
