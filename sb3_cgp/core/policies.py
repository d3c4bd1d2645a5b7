"""The policies of CGP: TD3's networks, an action selector, and the choice of which of them acts."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor, FlattenExtractor, NatureCNN
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.td3.policies import Actor, TD3Policy
from torch import nn

from sb3_cgp.common.rules import INFERENCES, SCORING_DTYPES, require_choice
from sb3_cgp.core.cem import CEM, ActionSelector, Selection
from sb3_cgp.fast.mlp import Perceptron
from sb3_cgp.fast.scoring import q_score, scoring_dtype


class CGPPolicy(TD3Policy):
    """
    Policy class of CGP for vector observations: an action selector, an actor, critics, and their averages.

    The averaged actor φ' of Algorithm 2 is ``actor_target``, the target critics θ' are ``critic_target``.

    :param observation_space: Observation space
    :param action_space: Action space
    :param lr_schedule: Learning rate schedule (could be constant)
    :param net_arch: The specification of the policy and value networks, two hidden layers of 256 units by default.
    :param activation_fn: Activation function
    :param features_extractor_class: Features extractor to use.
    :param features_extractor_kwargs: Keyword arguments to pass to the features extractor.
    :param normalize_images: Whether to normalize images or not, dividing by 255.0 (True by default)
    :param optimizer_class: The optimizer to use, ``th.optim.Adam`` by default
    :param optimizer_kwargs: Additional keyword arguments, excluding the learning rate, to pass to the optimizer.
        Adam is fused unless they say otherwise: the same step in fewer operations.
    :param n_critics: Number of critic networks to create.
    :param share_features_extractor: Whether to share or not the features extractor between the actor and the critic
        (this saves computation time)
    :param selector: Selects the actions that the critic rates highest, by default CEM with the paper's settings.
        Another sampler only needs the method of :class:`~sb3_cgp.core.cem.ActionSelector`.
    :param inference: What ``predict`` asks: the "actor", the "averaged_actor" or "cem" (the selector)
    :param cem_dtype: What all layers of the critic but the last compute in while the selector asks it: "float32",
        "bfloat16", or "auto", which is bfloat16 on processors that multiply it natively
    :raises ValueError: if ``inference`` or ``cem_dtype`` is not one of these
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        activation_fn: type[nn.Module] = nn.ReLU,
        features_extractor_class: type[BaseFeaturesExtractor] = FlattenExtractor,
        features_extractor_kwargs: dict[str, Any] | None = None,
        normalize_images: bool = True,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
        n_critics: int = 2,
        share_features_extractor: bool = False,
        selector: ActionSelector | None = None,
        inference: str = "actor",
        cem_dtype: str = "auto",
    ):
        require_choice("inference", inference, INFERENCES)
        require_choice("cem_dtype", cem_dtype, SCORING_DTYPES)
        optimizer_kwargs = optimizer_kwargs or {}
        if optimizer_class is th.optim.Adam and not optimizer_kwargs.keys() & {"fused", "foreach", "differentiable"}:
            optimizer_kwargs = optimizer_kwargs | {"fused": True}
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            [256, 256] if net_arch is None else net_arch,
            activation_fn,
            features_extractor_class,
            features_extractor_kwargs,
            normalize_images,
            optimizer_class,
            optimizer_kwargs,
            n_critics,
            share_features_extractor,
        )
        self.selector = CEM() if selector is None else selector
        self.inference = inference
        self.cem_dtype = cem_dtype
        self._action_dim = get_action_dim(action_space)
        self._select: Callable[..., Any] | None = None

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Actor:
        """
        Make TD3's actor, as a :class:`~sb3_cgp.fast.mlp.Perceptron`.

        :param features_extractor: the features extractor; None for one of its own
        :return: the actor
        """
        actor = super().make_actor(features_extractor)
        actor.mu = Perceptron(*actor.mu)
        return actor

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> ContinuousCritic:
        """
        Make TD3's critic, of :class:`~sb3_cgp.fast.mlp.Perceptron` s.

        :param features_extractor: the features extractor; None for one of its own
        :return: the critic
        """
        critic = super().make_critic(features_extractor)
        for index, q_network in enumerate(critic.q_networks):
            assert isinstance(q_network, nn.Sequential)
            critic.q_networks[index] = Perceptron(*q_network)
            critic.add_module(f"qf{index}", critic.q_networks[index])
        return critic

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.update(selector=self.selector, inference=self.inference, cem_dtype=self.cem_dtype)
        return data

    @th.no_grad()
    def select_actions(self, observation: PyTorchObs, critic: ContinuousCritic) -> Selection:
        """
        Select the actions that the first network of ``critic`` rates highest (π_CEM of Algorithm 1).

        Each observation passes the features extractor once. The critic works in evaluation mode, so that neither
        dropout nor batch statistics disturb the ranking and its running statistics stay as they are.

        :param observation: a batch of B observations, as tensors
        :param critic: the critic, or the target critic
        :return: the selected actions, (B, A), in the scaled action space, and the selector's last elites
        """
        was_training = critic.training
        if was_training:
            critic.eval()
        try:
            features = critic.extract_features(observation, critic.features_extractor)
            score = q_score(critic.q_networks[0], features, scoring_dtype(self.cem_dtype, features.device))
            return self.selector.select(score, features.shape[0], self._action_dim, features.device)
        finally:
            if was_training:
                critic.train()

    def set_training_mode(self, mode: bool) -> None:
        """
        Put the actor and the critic in either training or evaluation mode, as TD3's policy does.

        :param mode: if true, set to training mode, else set to evaluation mode
        """
        # Asked for at every prediction, and slow: it visits every module
        if not self.training == self.actor.training == self.critic.training == mode:
            super().set_training_mode(mode)

    @contextmanager
    def inferring_by(self, inference: str, select: Callable[..., Any] | None = None) -> Iterator[None]:
        """
        Let ``predict`` ask another network, or the selector, for a while.

        :param inference: "actor", "averaged_actor" or "cem"
        :param select: does what :meth:`select_actions` does with the critic, in its place
        """
        usual = self.inference, self._select
        self.inference, self._select = inference, select
        try:
            yield
        finally:
            self.inference, self._select = usual

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        # As in TD3, `deterministic` changes nothing: the actor has no noise, and CEM always samples
        if self.inference == "cem":
            if self._select is not None:
                return self._select(observation)[0]
            # Faster than without gradients alone
            with th.inference_mode():
                return self.select_actions(observation, self.critic).actions
        actor = self.actor_target if self.inference == "averaged_actor" else self.actor
        return actor(observation)


MlpPolicy = CGPPolicy


class CnnPolicy(CGPPolicy):
    """
    Policy class of CGP for images.

    :param observation_space: Observation space
    :param action_space: Action space
    :param lr_schedule: Learning rate schedule (could be constant)
    :param net_arch: The specification of the policy and value networks, two hidden layers of 256 units by default.
    :param activation_fn: Activation function
    :param features_extractor_class: Features extractor to use.
    :param kwargs: the further arguments of :class:`CGPPolicy`
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        activation_fn: type[nn.Module] = nn.ReLU,
        features_extractor_class: type[BaseFeaturesExtractor] = NatureCNN,
        **kwargs: Any,
    ):
        super().__init__(
            observation_space, action_space, lr_schedule, net_arch, activation_fn, features_extractor_class, **kwargs
        )


class MultiInputPolicy(CGPPolicy):
    """
    Policy class of CGP for ``Dict`` observation spaces.

    :param observation_space: Observation space
    :param action_space: Action space
    :param lr_schedule: Learning rate schedule (could be constant)
    :param net_arch: The specification of the policy and value networks, two hidden layers of 256 units by default.
    :param activation_fn: Activation function
    :param features_extractor_class: Features extractor to use.
    :param kwargs: the further arguments of :class:`CGPPolicy`
    """

    def __init__(
        self,
        observation_space: spaces.Dict,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        activation_fn: type[nn.Module] = nn.ReLU,
        features_extractor_class: type[BaseFeaturesExtractor] = CombinedExtractor,
        **kwargs: Any,
    ):
        super().__init__(
            observation_space, action_space, lr_schedule, net_arch, activation_fn, features_extractor_class, **kwargs
        )
