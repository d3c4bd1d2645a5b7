"""CGP with its critic called on repeated observations, the reference for the speed of the package's CGP."""

import torch as th
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.td3.policies import TD3Policy

from sb3_cgp.core.cem import Selection
from sb3_cgp.core.policies import CGPPolicy, repeated_q_score


class PlainPolicy(CGPPolicy):
    """
    CGP's policy with the observation repeated for every sample, in float32, one operation at a time.

    Its networks are SB3's. It does not set the critic's training mode, and so is right only for networks without dropout and
    batch norm.
    """

    make_actor = TD3Policy.make_actor
    make_critic = TD3Policy.make_critic

    @th.no_grad()
    def select_actions(self, observation: PyTorchObs, critic: ContinuousCritic) -> Selection:
        """
        Select the actions that the first network of ``critic`` rates highest.

        :param observation: a batch of B observations, as tensors
        :param critic: the critic, or the target critic
        :return: the selected actions, (B, A), in the scaled action space, and the selector's last elites
        """
        features = critic.extract_features(observation, critic.features_extractor)
        score = repeated_q_score(critic.q_networks[0], features)
        assert self.selector is not None
        return self.selector.select(score, len(features), get_action_dim(self.action_space), features.device)
