"""
Variants of CGP that may lower the bias of its critics.

Shapes: B states, N actions per state, F features, A action dimensions.
"""

from typing import Any

import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.type_aliases import GymEnv, ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from sb3_cgp import CGP, CGPPolicy
from sb3_cgp.core.cem import Score


class FlooredCGP(CGP):
    """
    CGP whose bootstrap value is at least the averaged actor's: ``max(min_j Q'_j(s', a'), min_j Q'_j(s', π'(s')))``.

    The parameters are those of :class:`sb3_cgp.CGP`.
    """

    def _setup_model(self) -> None:
        super()._setup_model()
        # `train` takes the minimum of what the target critic returns, and CEM asks its networks, not the critic
        self.critic_target.register_forward_hook(self._floor)

    def _floor(
        self, critic: ContinuousCritic, inputs: tuple[th.Tensor, th.Tensor], q_values: tuple[th.Tensor, ...]
    ) -> tuple[th.Tensor, ...]:
        """Raise the target critics' values to the minimum of their values of the averaged actor's action."""
        observations = inputs[0]
        features = critic.extract_features(observations, critic.features_extractor)
        rows = th.cat([features, self.actor_target(observations)], dim=1)
        floor = th.cat([q_network(rows) for q_network in critic.q_networks], dim=1).min(dim=1, keepdim=True).values
        return tuple(th.maximum(values, floor) for values in q_values)


class RecentBatchBuffer(ReplayBuffer):
    """SB3's replay buffer, which keeps the batch that it returned last. The parameters are those of ``ReplayBuffer``."""

    recent_batch: ReplayBufferSamples

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """
        Sample a batch of transitions.

        :param batch_size: number of transitions
        :param env: normalises observations and rewards; None leaves them as they are
        :return: the batch
        """
        self.recent_batch = super().sample(batch_size, env)
        return self.recent_batch


class ClampedCGP(CGP):
    """
    CGP whose bootstrap value is clamped to the range of targets seen so far, as in TD7 (arXiv 2306.02451).

    As in TD7, the range is 0 at first, and the range seen takes effect every 250 gradient steps.

    :param policy: the policy
    :param env: the environment
    :param kwargs: the further arguments of :class:`sb3_cgp.CGP`, without those of the replay buffer
    """

    RANGE_INTERVAL = 250

    def __init__(self, policy: str | type[CGPPolicy], env: GymEnv | str, **kwargs: Any):
        # The range in effect, and the range of all targets so far
        self.clamp_range = (0.0, 0.0)
        self.seen_range = (th.inf, -th.inf)
        super().__init__(policy, env, replay_buffer_class=RecentBatchBuffer, **kwargs)

    def _setup_model(self) -> None:
        super()._setup_model()
        self.critic_target.register_forward_hook(self._clamp)

    def _clamp(self, critic: ContinuousCritic, inputs: Any, q_values: tuple[th.Tensor, ...]) -> tuple[th.Tensor, ...]:
        """Clamp the target critics' values, which clamps their minimum, and note the targets' range."""
        clamped = tuple(values.clamp(*self.clamp_range) for values in q_values)
        assert isinstance(self.replay_buffer, RecentBatchBuffer)
        batch = self.replay_buffer.recent_batch
        next_q_values = th.cat(clamped, dim=1).min(dim=1, keepdim=True).values
        targets = batch.rewards + (1 - batch.dones) * self.gamma * next_q_values
        self.seen_range = (min(self.seen_range[0], targets.min().item()), max(self.seen_range[1], targets.max().item()))
        if self._n_updates % self.RANGE_INTERVAL == 0:
            self.clamp_range = self.seen_range
        return clamped


class MinScorePolicy(CGPPolicy):
    """CGP's policy whose selector ranks actions by the minimum of all critics. The parameters are those of ``CGPPolicy``."""

    def make_score(self, q_network: nn.Module, features: th.Tensor) -> Score:
        """
        Return the function that scores N actions for each of B states by the minimum over a critic's networks.

        :param q_network: the first network of the critic, or of the target critic
        :param features: the states' features, (B, F)
        :return: the scoring function, (B, N, A) -> (B, N); NaN where a network's value is NaN
        """
        critic = self.critic if q_network is self.critic.q_networks[0] else self.critic_target
        scores = []
        for each in critic.q_networks:
            scores.append(super().make_score(each, features))
        return lambda actions: th.stack([score(actions) for score in scores]).amin(dim=0)
