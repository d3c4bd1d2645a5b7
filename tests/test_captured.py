"""
Captured gradient steps. Where there is no GPU, a stand-in for the graph carries the recorded function out again on the memory
that it was recorded with: everything but PyTorch's CUDA graphs is tested on any machine, and these where there is a GPU.
"""

import copy
import warnings

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.noise import NormalActionNoise

from sb3_cgp import CGP, captured, gradient
from sb3_cgp.captured import EAGER_CALLS, Captured, LossWatch

needs_gpu = pytest.mark.skipif(not th.cuda.is_available(), reason="needs a GPU")
# Learning rates are powers of two: a captured one is a float32
SMALL = dict(learning_rate=2**-10, learning_starts=30, buffer_size=1_000, batch_size=16, cem_samples=8, cem_elites=2, seed=0)
VARIANTS = {
    "CGP-Online": dict(),
    "CGP-Offline": dict(policy_training="offline"),
    "QGP-Online": dict(policy_loss="qgp"),
    "CEM": dict(policy_loss=None),
    "delays": dict(policy_delay=3, target_update_interval=4),
    "n-step": dict(n_steps=3),
    "schedules": dict(
        learning_rate=lambda progress: 2 ** -round(10 - 4 * progress),
        actor_learning_rate=lambda progress: 2 ** -round(12 - 6 * progress),
    ),
    "noise": dict(action_noise=NormalActionNoise(np.zeros(1), 0.1 * np.ones(1))),
}


class StandIn:
    """Does what a recording does, by calling the function."""

    made = 0

    def __init__(self, function, inputs):
        StandIn.made += 1
        self.function, self.inputs = function, captured._clones(inputs)

    fits = captured.Recording.fits

    @property
    def _inputs(self):
        return self.inputs

    def replay(self, inputs):
        for recorded, new in zip(self.inputs, inputs, strict=True):
            if recorded is not None:
                recorded.copy_(new)
        return captured._clones(self.function(*self.inputs))


@pytest.fixture
def stand_in(monkeypatch):
    """Capture on the CPU, by the stand-in."""
    monkeypatch.setattr(gradient, "can_capture", lambda device: True)
    monkeypatch.setattr(captured, "Recording", StandIn)
    monkeypatch.setattr("sb3_cgp.offline.ROUND", 10)
    monkeypatch.setattr(StandIn, "made", 0)


def make_model(**kwargs):
    return CGP("MlpPolicy", "Pendulum-v1", policy_kwargs=dict(net_arch=[16]), **(SMALL | kwargs))


def parameters(model):
    return th.cat([parameter.detach().flatten().cpu() for parameter in model.policy.parameters()])


@pytest.mark.parametrize("name", VARIANTS)
def test_captured_training_is_eager_training(stand_in, name):
    taken = make_model(**VARIANTS[name]).learn(80)
    assert taken._is_captured
    assert StandIn.made > 0
    eager = make_model(**VARIANTS[name], cuda_graphs=False).learn(80)
    assert not eager._is_captured
    assert taken._n_updates == eager._n_updates == 50
    assert th.equal(parameters(taken), parameters(eager))


def test_every_combination_of_turns_is_recorded_once_and_acting_too(stand_in):
    model = make_model(policy_delay=2, target_update_interval=3).learn(30 + 6 * (EAGER_CALLS + 5))
    # Two by two turns, and the selection of actions
    assert len(model._captured_steps) == 4
    assert StandIn.made == 4 + 1


def test_a_changed_setting_is_recorded_anew(stand_in):
    models = [make_model(cuda_graphs=cuda_graphs).learn(60) for cuda_graphs in (True, False)]
    for model in models:
        model.set_random_seed(3)
        model.gamma, model.tau, model.target_policy_noise = 0.5, 0.1, 0.0
        model.learn(60, reset_num_timesteps=False)
    assert th.equal(*map(parameters, models))


def test_parameters_that_are_set_are_trained_on(stand_in):
    models = [make_model(cuda_graphs=cuda_graphs).learn(60) for cuda_graphs in (True, False)]
    other = make_model(seed=7, cuda_graphs=False).learn(50)
    for model in models:
        # An optimiser keeps the very tensors that it is given
        model.set_parameters(copy.deepcopy(other.get_parameters()))
        model.set_random_seed(3)
        model.learn(60, reset_num_timesteps=False)
    assert th.equal(*map(parameters, models))


def test_a_captured_model_goes_on_where_nothing_is_captured(stand_in, tmp_path, monkeypatch):
    model = make_model().learn(60)
    model.save(tmp_path / "model")
    monkeypatch.setattr(gradient, "can_capture", lambda device: False)
    loaded = CGP.load(tmp_path / "model", env=model.get_env())
    for optimizer in (loaded.actor.optimizer, loaded.critic.optimizer):
        (group,) = optimizer.param_groups
        assert type(group["lr"]) is float
        assert group["capturable"] is False
    loaded.learn(60)
    assert loaded._n_updates > model._n_updates


def test_losses_are_logged_when_the_log_is_written(stand_in):
    model = make_model().learn(100)
    assert "train/critic_loss" not in model.logger.name_to_value
    recorded = {}
    model.logger.dump = lambda step: recorded.update(model.logger.name_to_value)
    model.dump_logs()
    assert recorded["train/critic_loss"] == pytest.approx(model._last_losses[-1].critic.item())
    assert recorded["train/actor_loss"] == pytest.approx(model._last_losses[-1].actor.item())


def test_a_nan_loss_is_skipped_by_the_device_and_raised_when_it_is_read(stand_in):
    model = make_model().learn(60)
    model.replay_buffer.rewards[:] = np.nan
    before = [parameter.clone() for parameter in model.critic.parameters()]
    updates = model._n_updates
    model.train(4, 16)
    assert model._n_updates == updates + 4
    assert all(map(th.equal, before, model.critic.parameters()))
    with pytest.raises(ValueError, match=f"The critic loss was NaN or infinite at gradient step {updates + 1}"):
        model.dump_logs()


def test_a_nan_loss_ends_the_training_at_the_next_look_at_it(stand_in):
    model = make_model().learn(60)
    model.replay_buffer.rewards[:] = np.inf
    with pytest.raises(ValueError, match="critic loss was NaN or infinite at gradient step 31"):
        model.learn(5, reset_num_timesteps=False)


def test_what_cannot_be_recorded_is_carried_out_with_one_warning(stand_in, monkeypatch):
    def refuse(function, inputs):
        raise RuntimeError("operation not permitted")

    monkeypatch.setattr(captured, "Recording", refuse)
    with pytest.warns(UserWarning, match="No CUDA graph .* operation not permitted") as warned:
        model = make_model(target_update_interval=1).learn(80)
    # Gradient steps, and the selection of actions
    assert len([warning for warning in warned if "CUDA graph" in str(warning.message)]) == 2
    assert th.equal(parameters(model), parameters(make_model(target_update_interval=1, cuda_graphs=False).learn(80)))


@pytest.mark.parametrize(
    "kwargs",
    [
        dict(optimizer_class=th.optim.SGD),
        dict(optimizer_kwargs=dict(fused=False)),
    ],
)
def test_other_optimisers_are_not_captured(stand_in, kwargs):
    model = make_model()
    assert model._is_captured
    assert not CGP("MlpPolicy", "Pendulum-v1", policy_kwargs=dict(net_arch=[8]) | kwargs, **SMALL)._is_captured


def test_a_function_is_called_then_recorded_once_then_replayed(monkeypatch):
    monkeypatch.setattr(captured, "Recording", StandIn)
    monkeypatch.setattr(StandIn, "made", 0)
    calls = []

    def double(tensor, nothing):
        calls.append(tensor)
        return 2 * tensor, None

    function = Captured(double)
    for value in range(EAGER_CALLS + 3):
        doubled, nothing = function(th.full((2,), float(value)), None)
        assert doubled.tolist() == [2.0 * value] * 2
        assert nothing is None
        assert StandIn.made == (value >= EAGER_CALLS)
    # Another shape or type than the recorded one
    assert function(th.ones(3), None)[0].tolist() == [2.0] * 3
    assert function(th.ones(2, dtype=th.long), None)[0].dtype == th.long
    assert StandIn.made == 1
    # What was returned before is not overwritten
    first = function(th.ones(2), None)[0]
    function(th.zeros(2), None)
    assert first.tolist() == [2.0, 2.0]


def test_the_watch_remembers_the_first_bad_step_of_each_loss():
    watch = LossWatch(("critic", "actor"), n_updates=10, device=th.device("cpu"))
    seen = []
    for critic, actor in [(1.0, 2.0), (3.0, np.inf), (np.nan, np.nan), (np.nan, 1.0)]:
        watch.begin_step()
        seen.append((watch.see("critic", th.tensor(critic)).item(), watch.see("actor", th.tensor(actor)).item()))
    assert seen == [(0.0, 0.0), (0.0, 1.0), (1.0, 1.0), (1.0, 0.0)]
    with pytest.raises(ValueError, match="critic loss was NaN or infinite at gradient step 13"):
        watch.check()
    LossWatch(("critic",), 0, th.device("cpu")).check()


@needs_gpu
@pytest.mark.parametrize("name", VARIANTS)
def test_graphs_train_as_eager_steps_do(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        models = [
            make_model(**VARIANTS[name], device="cuda", cuda_graphs=cuda_graphs).learn(60) for cuda_graphs in (True, False)
        ]
    assert [model._is_captured for model in models] == [True, False]
    assert any(step._recording is not None for step in models[0]._captured_steps.values())
    th.testing.assert_close(*map(parameters, models), rtol=1e-3, atol=1e-4)


@needs_gpu
def test_graphs_obey_schedules_and_set_parameters():
    model = make_model(device="cuda", learning_rate=lambda progress: 0.0 if progress < 0.5 else 1e-2)
    model.learn(100)
    trained = [*model.actor.parameters(), *model.critic.parameters()]
    before = [parameter.clone() for parameter in trained]
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
