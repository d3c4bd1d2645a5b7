"""The policies of CGP: TD3's networks, an action selector, and the choice of which of them acts."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import CombinedExtractor, NatureCNN
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.td3.policies import TD3Policy
from torch import nn

from sb3_cgp.common.networks import evaluation_mode
from sb3_cgp.common.rules import require, require_choice
from sb3_cgp.core.cem import ActionSelector, Score, Selection


def repeated_q_score(q_network: nn.Module, features: th.Tensor) -> Score:
    """
    Return the function that scores N actions for each of B states by a Q-network, by repeating the states' features.

    :param q_network: maps features and actions side by side, (rows, F + A), to values, (rows, 1)
    :param features: the states' features, (B, F)
    :return: the scoring function, (B, N, A) -> (B, N)
    """

    def score(actions: th.Tensor) -> th.Tensor:
        repeated = features.unsqueeze(1).expand(-1, actions.shape[1], -1)
        values: th.Tensor = q_network(th.cat([repeated, actions], dim=2).flatten(0, 1))
        return values.view(actions.shape[:2])

    return score


class CGPPolicy(TD3Policy):
    """
    Policy class of CGP for vector observations: an action selector, an actor, critics, and their averages.

    The averaged actor φ' of Algorithm 2 is ``actor_target``, the target critics θ' are ``critic_target``.

    :param observation_space: Observation space
    :param action_space: Action space
    :param lr_schedule: Learning rate schedule (could be constant)
    :param net_arch: The specification of the policy and value networks, two hidden layers of 256 units by default.
    :param selector: Selects the actions that the critic rates highest. None stands for the algorithm's CEM. Another
        selector needs the one method of :class:`~sb3_cgp.core.cem.ActionSelector`.
    :param inference: What ``predict`` uses: the "actor", the "averaged_actor" or "cem" (the selector)
    :param kwargs: the further arguments of SB3's ``TD3Policy``, such as ``activation_fn`` and ``n_critics``
    :raises ValueError: if ``inference`` is not one of these
    """

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Box,
        lr_schedule: Schedule,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        *,
        selector: ActionSelector | None = None,
        inference: str = "actor",
        **kwargs: Any,
    ):
        require_choice("inference", inference, ("actor", "averaged_actor", "cem"))
        super().__init__(observation_space, action_space, lr_schedule, [256, 256] if net_arch is None else net_arch, **kwargs)
        self.selector = selector
        self.inference = inference

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return super()._get_constructor_parameters() | dict(selector=self.selector, inference=self.inference)

    def make_score(self, q_network: nn.Module, features: th.Tensor) -> Score:
        """Return the function that scores N actions for each of B states, see :func:`repeated_q_score`."""
        return repeated_q_score(q_network, features)

    @th.no_grad()
    def select_actions(self, observation: PyTorchObs, critic: ContinuousCritic) -> Selection:
        """
        Select the actions that the first network of a critic rates highest (π_CEM of Algorithm 1).

        Each observation passes the critic's features extractor once. The critic is in evaluation mode meanwhile.

        :param observation: a batch of B observations, as tensors
        :param critic: the critic, or the target critic
        :return: the selected actions, (B, A), in the scaled action space, and the elites
        :raises ValueError: if the policy has no selector, as where it was made without an algorithm
        """
        selector = self.selector
        require(selector is not None, "selector", selector, "an action selector, such as sb3_cgp.CEM()")
        assert selector is not None
        with evaluation_mode(critic):
            features = critic.extract_features(observation, critic.features_extractor)
            score = self.make_score(critic.q_networks[0], features)
            sizes = features.shape[0], get_action_dim(self.action_space)
            return selector.select(score, *sizes, features.device, **self.selector_arguments(observation, critic))

    def selector_arguments(self, observation: PyTorchObs, critic: ContinuousCritic) -> dict[str, Any]:
        """Return further arguments of the selector's ``select``, of which the paper has none; subclasses override this."""
        return {}

    @contextmanager
    def acting_by(self, inference: str) -> Iterator[None]:
        """Let ``predict`` use the "actor", the "averaged_actor" or "cem" (the selector) within a ``with`` block."""
        usual, self.inference = self.inference, inference
        try:
            yield
        finally:
            self.inference = usual

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        # As in TD3, `deterministic` has no effect: the actor has no noise, and CEM always samples
        if self.inference == "cem":
            return self.select_actions(observation, self.critic).actions
        actor = self.actor_target if self.inference == "averaged_actor" else self.actor
        actions: th.Tensor = actor(observation)
        return actions


MlpPolicy = CGPPolicy


class CnnPolicy(CGPPolicy):
    """Policy class of CGP for images: :class:`CGPPolicy` with SB3's ``NatureCNN`` as its features extractor."""

    def __init__(self, *args: Any, features_extractor_class: type = NatureCNN, **kwargs: Any):
        super().__init__(*args, features_extractor_class=features_extractor_class, **kwargs)


class MultiInputPolicy(CGPPolicy):
    """Policy class of CGP for ``Dict`` observations: :class:`CGPPolicy` with SB3's ``CombinedExtractor``."""

    def __init__(self, *args: Any, features_extractor_class: type = CombinedExtractor, **kwargs: Any):
        super().__init__(*args, features_extractor_class=features_extractor_class, **kwargs)
