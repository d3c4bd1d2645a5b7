"""Gradient steps as CUDA graphs on a GPU."""

import warnings

import pytest
import torch as th
from graph_models import SMALL, VARIANTS, make_model, parameters

from sb3_cgp import CEM, CGP

needs_gpu = pytest.mark.usefixtures("gpu")


@needs_gpu
@pytest.mark.parametrize("name", VARIANTS)
def test_graphs_train_as_eager_steps_do(monkeypatch, name):
    monkeypatch.setattr("sb3_cgp.core.offline.ROUND", 10)
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        models = [
            make_model(**VARIANTS[name], device="cuda", cuda_graphs=cuda_graphs).learn(90) for cuda_graphs in (True, False)
        ]
    assert [model._records_steps for model in models] == [True, False]
    assert all(capture._recording is not None for capture in models[0]._recorded.values())
    th.testing.assert_close(*map(parameters, models), rtol=1e-3, atol=1e-4)


@needs_gpu
def test_a_selector_that_synchronizes_is_not_recorded_and_works():
    class Waiting(CEM):
        def select(self, score, n_states, action_dim, device="cpu"):
            selection = super().select(score, n_states, action_dim, device)
            assert selection.actions.abs().max().item() <= 1.0
            return selection

    model = CGP("MlpPolicy", "Pendulum-v1", device="cuda", policy_kwargs=dict(selector=Waiting(2, 8, 2)), **SMALL)
    with pytest.warns(UserWarning, match="The host synchronises with the GPU in"):
        model.learn(60)
    assert model._n_updates == 30
    assert all(capture._recording is None for capture in model._recorded.values())


@needs_gpu
def test_graphs_obey_schedules_and_set_parameters():
    model = make_model(device="cuda", learning_rate=lambda progress: 0.0 if progress < 0.5 else 1e-2)
    model.learn(100)
    trained = [*model.actor.parameters(), *model.critic.parameters()]
    before = [parameter.detach().clone() for parameter in trained]
    model._current_progress_remaining = 0.1
    model.train(20, 16)
    assert all(map(th.equal, before, trained))
    other = make_model(device="cuda", seed=9)
    model.set_parameters(other.get_parameters())
    assert th.equal(parameters(model), parameters(other))
    model._current_progress_remaining = 1.0
    model.train(20, 16)
    assert not th.equal(parameters(model), parameters(other))
    # Twenty steps of Adam go hardly farther than twenty times the learning rate
    th.testing.assert_close(parameters(model), parameters(other), rtol=0.0, atol=20 * 2e-2)


@needs_gpu
def test_what_cannot_be_recorded_on_a_gpu_is_carried_out_and_spoils_nothing():
    def train(cuda_graphs):
        model = make_model(device="cuda", cuda_graphs=cuda_graphs).learn(60)
        # Whoever keeps a graph of autograd binds the parameters' gradients to the stream that it was made on
        kept = [parameter.clone() for parameter in model.policy.parameters()]
        model.set_parameters(model.get_parameters())
        return model.learn(60, reset_num_timesteps=False), kept

    before = make_model(device="cuda").learn(60)
    with pytest.warns(UserWarning, match="A step cannot be recorded as a CUDA graph, and is slower"):
        taken = train(cuda_graphs=True)[0]
    assert any(capture._recording is None for capture in taken._recorded.values())
    th.testing.assert_close(parameters(taken), parameters(train(cuda_graphs=False)[0]), rtol=1e-3, atol=1e-4)
    for model in (before, make_model(device="cuda")):
        model.learn(60)
        assert all(capture._recording is not None for capture in model._recorded.values())
