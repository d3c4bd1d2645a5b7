"""The actor alone as the selector, with which CGP is SB3's TD3 or DDPG."""

import math

import numpy as np
import pytest
import torch as th
from environments import Doubles
from scores import Seen
from stable_baselines3 import DDPG, TD3
from stable_baselines3.common.noise import NormalActionNoise

from sb3_cgp import CGP, MlpPolicy
from sb3_cgp.selectors import ActorOnly
from sb3_cgp.selectors.policies import CGPPolicy


def noise():
    return NormalActionNoise(np.zeros(2), 0.1 * np.ones(2))


def test_selects_the_first_proposal_as_it_is_whose_value_before_tanh_is_clipped_at_that_of_099():
    proposals = th.tensor([[[0.5, -0.9], [0.1, 0.2]], [[0.0, -0.989], [0.3, 0.4]], [[1.0, -0.995], [0.5, 0.6]]])
    seen = Seen()
    selection = ActorOnly().select(seen, 3, 2, proposals=proposals)
    assert th.equal(selection.actions, proposals[:, 0])
    expected = [[math.atanh(max(min(action, 0.99), -0.99)) for action in state[0]] for state in proposals.tolist()]
    assert th.allclose(selection.elites, th.tensor(expected).unsqueeze(1), atol=1e-4)
    assert seen.actions == []


@pytest.mark.parametrize(
    ("algorithm", "own", "kwargs"),
    [
        (TD3, dict(policy_delay=2), dict(policy_delay=2, target_update_interval=2)),
        (TD3, dict(policy_delay=3, gradient_steps=2), dict(policy_delay=3, target_update_interval=3, gradient_steps=2)),
        (
            TD3,
            dict(policy_kwargs=dict(net_arch=[16], n_critics=1), target_policy_noise=0.0, policy_delay=1),
            dict(policy_kwargs=dict(net_arch=[16], n_critics=1), target_policy_noise=0.0, target_update_interval=1),
        ),
        (
            DDPG,
            dict(),
            dict(policy_kwargs=dict(net_arch=[16], n_critics=1), target_policy_noise=0.1, target_noise_clip=0.0,
                 target_update_interval=1),
        ),
        (TD3, dict(n_steps=3), dict(n_steps=3, policy_delay=2, target_update_interval=2)),
    ],
)  # fmt: skip
def test_the_actor_alone_is_sb3s_own_to_the_bit(algorithm, own, kwargs):
    """The core's networks and SB3's optimizer: the same operations, in the same order, on the same random numbers."""
    equals_sb3(algorithm, own, kwargs, CGPPolicy, dict(optimizer_kwargs=dict(fused=False)), tolerance=0)


def test_the_actor_alone_is_sb3s_td3_but_for_the_fast_networks_rounding():
    equals_sb3(TD3, dict(policy_delay=2), dict(policy_delay=2, target_update_interval=2), MlpPolicy, dict(), tolerance=1e-4)


def equals_sb3(algorithm, own, kwargs, policy, policy_kwargs, tolerance):
    """Compare networks, minibatches, noise, targets, losses, updates and actions, after hundreds of steps."""
    common = dict(
        env=Doubles(), learning_starts=100, buffer_size=1_000, batch_size=32, learning_rate=1e-3, seed=0, device="cpu"
    )
    common["policy_kwargs"] = dict(net_arch=[16])
    theirs = algorithm("MlpPolicy", action_noise=noise(), **(common | own)).learn(300)
    kwargs = common | kwargs
    kwargs["policy_kwargs"] = dict(selector=ActorOnly(), **policy_kwargs, **kwargs["policy_kwargs"])
    ours = CGP(policy, policy_loss="qgp", action_noise=noise(), **kwargs).learn(300)
    assert ours._n_updates == theirs._n_updates >= 200
    expected, actual = theirs.policy.state_dict(), ours.policy.state_dict()
    assert actual.keys() == expected.keys()
    for name, value in expected.items():
        th.testing.assert_close(actual[name], value, rtol=0, atol=tolerance, msg=name)
    np.testing.assert_allclose(ours.replay_buffer.actions[:300], theirs.replay_buffer.actions[:300], atol=tolerance)
    # The training has changed what was there
    untrained = algorithm("MlpPolicy", **(common | own)).policy.state_dict()
    assert any(not th.allclose(untrained[name], value, atol=1e-2) for name, value in expected.items())
