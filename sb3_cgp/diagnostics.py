"""What the training logs about the policy, beside its losses."""

import torch as th

from sb3_cgp.core.policies import CGPPolicy

# A scaled action beyond this magnitude counts as saturated
SATURATION = 0.99


@th.no_grad()
def policy_diagnostics(policy: CGPPolicy, observations: th.Tensor, has_actor: bool) -> dict[str, float]:
    """
    Measure how sure CEM is of its actions and how well the actor does beside it, at the price of one run of CEM.

    :param policy: the policy, in evaluation mode
    :param observations: a batch of observations (tensors by key for ``Dict`` spaces)
    :param has_actor: whether there is an actor in training
    :return: the figures by their keys in the log: CEM's final standard deviation before tanh, the share of its
        actions beyond a magnitude of 0.99; root mean squared distance of the actor's actions from CEM's (scaled, per
        dimension), and how much more Q-value the first critic gives to CEM's
    """
    selection = policy.select_actions(observations, policy.critic)
    actions = selection.actions
    figures = {
        "train/cem_spread": selection.spread.mean().item(),
        "train/saturated_actions": (actions.abs() > SATURATION).float().mean().item(),
    }
    if has_actor:
        actor_actions = policy.actor(observations)
        distance = (actor_actions - actions).square().mean().sqrt()
        q_values, actor_q_values = (policy.critic.q1_forward(observations, a) for a in (actions, actor_actions))
        figures["train/actor_cem_distance"] = distance.item()
        figures["train/cem_q_advantage"] = (q_values - actor_q_values).mean().item()
    return figures
