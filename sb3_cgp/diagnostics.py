"""Diagnostics of the policy, logged beside the losses: how certain CEM is, and how well the actor does in comparison."""

from typing import Any

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_cgp.common.random_state import preserved_random_state
from sb3_cgp.common.rules import require
from sb3_cgp.core.cgp import CGP
from sb3_cgp.core.policies import CGPPolicy

# Gradient steps between two diagnoses, each of which costs a run of CEM
INTERVAL = 100
# A scaled action beyond this magnitude counts as saturated
SATURATION = 0.99


@th.no_grad()
def policy_diagnostics(policy: CGPPolicy, observations: PyTorchObs, has_actor: bool) -> dict[str, float]:
    """
    Compare the actor with CEM on a batch of observations, at the cost of one run of CEM.

    :param policy: the policy, in evaluation mode
    :param observations: a batch of observations (tensors by key for ``Dict`` spaces)
    :param has_actor: whether an actor is trained
    :return: the values by their keys in the log: CEM's final standard deviation before tanh, the share of its
        actions beyond a magnitude of 0.99; root mean squared distance of the actor's actions from CEM's (scaled, per
        dimension), and the difference of their Q-values by the first critic
    """
    selection = policy.select_actions(observations, policy.critic)
    actions = selection.actions
    values = {
        "train/cem_std": selection.std.mean().item(),
        "train/saturated_actions": (actions.abs() > SATURATION).float().mean().item(),
    }
    if has_actor:
        actor_actions = policy.actor(observations)
        distance = (actor_actions - actions).square().mean().sqrt()
        # SB3's type hint omits the tensors of a Dict space
        q_values, actor_q_values = (
            policy.critic.q1_forward(observations, each) for each in (actions, actor_actions)  # type: ignore[arg-type]
        )
        values["train/actor_cem_distance"] = distance.item()
        values["train/cem_q_advantage"] = (q_values - actor_q_values).mean().item()
    return values


class DiagnosticsAlgorithm(CGP):
    """
    CGP that logs diagnostics of its policy every 100 gradient steps, and the ratio of gradient steps to environment steps.

    The diagnostics neither change the training nor its random numbers.
    """

    # The argument of the constructor
    diagnostics: bool = True
    # Environment steps at the last call of `train`
    _timesteps_trained_at: int = 0

    def _setup_model(self) -> None:
        require(isinstance(self.diagnostics, bool), "diagnostics", self.diagnostics, "True or False")
        super()._setup_model()

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, Any]:
        result = super()._setup_learn(*args, **kwargs)
        self._timesteps_trained_at = max(self.num_timesteps, self.learning_starts)
        return result

    def train(self, gradient_steps: int, batch_size: int = 128) -> None:
        """
        Do gradient steps, and log diagnostics if they are due.

        :param gradient_steps: number of gradient steps
        :param batch_size: number of transitions in a minibatch
        """
        n_updates = self._n_updates
        super().train(gradient_steps, batch_size)
        steps, self._timesteps_trained_at = self.num_timesteps - self._timesteps_trained_at, self.num_timesteps
        self.logger.record("train/updates_per_step", gradient_steps / max(steps, 1))
        if self._n_updates // INTERVAL > n_updates // INTERVAL:
            self._log_diagnostics(batch_size, self._trains_online)

    def _record_round(self, losses: list[th.Tensor]) -> None:
        super()._record_round(losses)
        self._log_diagnostics(self.batch_size, has_actor=True)

    def _log_diagnostics(self, batch_size: int, has_actor: bool) -> None:
        if not self.diagnostics:
            return
        assert self.replay_buffer is not None
        self.policy.set_training_mode(False)
        with preserved_random_state(self.device):
            observations = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env).observations
            values = policy_diagnostics(self.policy, observations, has_actor)
        for key, value in values.items():
            self.logger.record_mean(key, value)
        self.policy.set_training_mode(True)
