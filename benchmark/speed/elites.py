"""The share of CEM's elites in float32 that are its elites in bfloat16, too."""

import torch as th
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.preprocessing import get_action_dim

from sb3_cgp import CEM, CGP
from sb3_cgp.core.cem import Score
from sb3_cgp.fast.scoring import q_score

# Replayed states whose elites are compared
STATES = 2_000


def elite_overlaps(cem: CEM, exact: Score, rounded: Score, n_states: int, action_dim: int) -> list[float]:
    """
    Compare the elites of two scoring functions along CEM's search by the first.

    :param cem: the search
    :param exact: scores (B, N, A) -> (B, N), and is followed
    :param rounded: scores in the same way, and is only compared
    :param n_states: number of states, B
    :param action_dim: action dimensions, A
    :return: for each iteration, the share of the first's elites that are the second's, too
    """
    overlaps = []

    def score(actions: th.Tensor) -> th.Tensor:
        values = exact(actions)
        elites, others = (scores.topk(cem.elites, dim=1).indices for scores in (values, rounded(actions)))
        shared = (elites.unsqueeze(2) == others.unsqueeze(1)).any(dim=2)
        overlaps.append(shared.float().mean().item())
        return values

    cem.select(score, n_states, action_dim)
    return overlaps


@th.no_grad()
def critic_overlaps(model: CGP, critic: ContinuousCritic) -> list[float]:
    """
    Compare the elites of bfloat16 with float32's on a model's replayed states.

    :param model: the model, trained
    :param critic: its critic or its target critic
    :return: the overlap in each iteration
    """
    model.policy.set_training_mode(False)
    assert model.replay_buffer is not None
    observations = model.replay_buffer.sample(STATES, env=model.get_vec_normalize_env()).observations
    features = critic.extract_features(observations, critic.features_extractor)
    network = critic.q_networks[0]
    exact, rounded = (q_score(network, features, dtype) for dtype in (th.float32, th.bfloat16))
    cem = model.policy.selector
    assert isinstance(cem, CEM)
    return elite_overlaps(cem, exact, rounded, len(features), get_action_dim(model.action_space))
