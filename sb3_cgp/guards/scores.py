"""A critic that learns other values than those by which the selector of actions ranks them."""

from collections.abc import Callable
from typing import Any

import torch as th
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_cgp.common.networks import evaluation_mode
from sb3_cgp.common.random_state import preserved_random_state

# Relative to the largest value: a critic may compute in bfloat16
TOLERANCE = 2e-2


def check_scores(policy: Any, model: OffPolicyAlgorithm, observations: Any) -> None:
    """
    Compare the values of actions that a policy's selector scores with those that its critic returns.

    The policies of this package score by the critic's first network. A policy with a ``make_score`` of its own, and a selector
    that scores nothing, may have any critic.

    :param policy: a copy of the model's policy, which is changed; one without a selector is not checked
    :param model: the model
    :param observations: a batch of B observations, as tensors
    :raises ValueError: if the critic returns other values, naming the method to override
    """
    usual = [each.make_score for each in model.policy_aliases.values() if hasattr(each, "make_score")]
    if not hasattr(policy, "select_actions") or type(policy).make_score not in usual:
        return
    scored: list[th.Tensor] = []
    make_score = policy.make_score

    def make_noting_score(q_network: th.nn.Module, features: th.Tensor) -> Callable[[th.Tensor], th.Tensor]:
        score = make_score(q_network, features)

        def noting_score(actions: th.Tensor) -> th.Tensor:
            scored.append(actions[:, 0])
            return score(actions)

        return noting_score

    policy.make_score = make_noting_score
    policy.select_actions(observations, policy.critic)
    if scored:
        _require_equal_values(policy.critic, model, observations, scored[0])


def _require_equal_values(critic: Any, model: OffPolicyAlgorithm, observations: Any, actions: th.Tensor) -> None:
    """Compare the values of one action for each observation, (B, A), by the critic's first network and by its ``forward``."""

    def evaluate(call: Callable[[], th.Tensor]) -> th.Tensor:
        # A features extractor may be random in evaluation mode, too
        with th.no_grad(), evaluation_mode(critic), preserved_random_state(model.device):
            return call()

    def score() -> th.Tensor:
        features = critic.extract_features(observations, critic.features_extractor)
        return critic.q_networks[0](th.cat([features, actions], dim=1))

    scores, values = evaluate(score).float(), evaluate(lambda: critic(observations, actions)[0]).float()
    atol = TOLERANCE * float(scores.nan_to_num().abs().max())
    if not th.allclose(values, scores, rtol=0.0, atol=atol, equal_nan=True):
        raise ValueError(
            f"The selector would choose actions by other values than the critic learns: `{type(critic).__name__}.forward` "
            f"returns {_in_words(values)}, where the critic's first network returns {_in_words(scores)} for the features and "
            f"the actions. Override `make_score(q_network, features)` of `{type(model.policy).__name__}`, so that it returns "
            "a function that scores actions as `forward` does."
        )


def _in_words(values: th.Tensor) -> str:
    return ", ".join(f"{value:.3g}" for value in values.flatten().tolist())
