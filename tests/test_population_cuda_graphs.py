"""CUDA graphs of a population's gradient steps, with a stand-in for a GPU and on a GPU."""

import warnings

import pytest
import torch as th
from graph_models import StandIn
from populations import AGENTS, VARIANTS, make

from sb3_cgp.fast import cuda_graphs
from sb3_cgp.population import training


@pytest.mark.parametrize("variant", ["CGP", "CGP-Light", "TD3", "CEM"])
def test_recorded_gradient_steps_are_the_ordinary_ones(variant, monkeypatch):
    ordinary = make(AGENTS, **VARIANTS[variant]).learn(3 * 80)
    monkeypatch.setattr(training, "has_cuda_graphs", lambda device: True)
    monkeypatch.setattr(cuda_graphs, "Recording", StandIn)
    monkeypatch.setattr(StandIn, "made", 0)
    recorded = make(AGENTS, **VARIANTS[variant]).learn(3 * 80)
    assert StandIn.made > 0
    # Acting, too
    assert None in {due for due, *_ in recorded._recorded}
    assert not any(each._stays_eager for each in recorded._recorded.values())
    for name, value in ordinary.policy.state_dict().items():
        assert th.equal(recorded.policy.state_dict()[name], value), name


@pytest.mark.usefixtures("short_policy_training")
@pytest.mark.filterwarnings("ignore:The policy's loss has not reached a plateau", "ignore:Agent 1 learns nothing")
def test_recorded_gradient_steps_ask_the_actors_that_are_trained(monkeypatch):
    def train():
        # The second agent's actor is trained at the end of the second training
        population = make([dict(), dict(learning_starts=50)], **VARIANTS["from the actor, offline"])
        for _ in range(3):
            population.learn(2 * 40, reset_num_timesteps=False)
        return population

    ordinary = train()
    monkeypatch.setattr(training, "has_cuda_graphs", lambda device: True)
    monkeypatch.setattr(cuda_graphs, "Recording", StandIn)
    recorded = train()
    assert {has_actor for *_, has_actor in recorded._recorded} == {(False, False), (True, False), (True, True)}
    assert not any(each._stays_eager for each in recorded._recorded.values())
    for name, value in ordinary.policy.state_dict().items():
        assert th.equal(recorded.policy.state_dict()[name], value), name


@pytest.mark.usefixtures("gpu")
@pytest.mark.parametrize("variant", ["CGP", "QGP", "CGP-Light", "MPPI from the actor", "TD3", "CEM", "n-step"])
def test_on_a_gpu_gradient_steps_are_recorded_and_compute_the_same(variant):
    with warnings.catch_warnings():
        # Such as one that the host synchronises
        warnings.simplefilter("error", UserWarning)
        recorded, ordinary = (
            make(AGENTS, device="cuda", cuda_graphs=cuda_graphs, **VARIANTS[variant]).learn(3 * 80)
            for cuda_graphs in (True, False)
        )
    assert any(each._recording is not None for each in recorded._recorded.values())
    assert not any(each._stays_eager for each in recorded._recorded.values())
    assert ordinary._recorded == {}
    for index, agent in enumerate(recorded):
        for name, value in ordinary[index].policy.state_dict().items():
            th.testing.assert_close(agent.policy.state_dict()[name], value, rtol=1e-3, atol=1e-3, msg=name)
