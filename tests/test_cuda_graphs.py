"""
Gradient steps as CUDA graphs. Without a GPU, a stand-in for the graph carries the recorded function out again on the memory
that it was recorded with: everything but PyTorch's CUDA graphs is tested on any machine, and these where there is a GPU.
"""

import copy
import pickle
import re
import warnings
from contextlib import contextmanager, nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
import torch as th
from environments import Doubles
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_cgp import CEM, CGP
from sb3_cgp.fast import cuda_graph_algorithm, cuda_graphs
from sb3_cgp.fast.cuda_graphs import WARM_UP_CALLS, RecordedFunction
from sb3_cgp.fast.recorded_optimizers import LossWatch

needs_gpu = pytest.mark.usefixtures("gpu")
# Learning rates are powers of two: a recorded one is a float32
SMALL = dict(
    cuda_graphs=True,
    learning_rate=2**-10,
    learning_starts=30,
    buffer_size=1_000,
    batch_size=16,
    cem_samples=8,
    cem_elites=2,
    seed=0,
)
VARIANTS = {
    "CGP-Online": dict(),
    "CGP-Offline": dict(policy_training="offline"),
    "QGP-Online": dict(policy_loss="qgp"),
    "CEM": dict(policy_loss=None),
    "CGP-Light": dict(cem_start="actor", cem_iterations=1),
    "from the actor, offline": dict(cem_start="actor", policy_training="offline"),
    "delays": dict(policy_delay=3, target_update_interval=4),
    "n-step": dict(n_steps=3),
    "schedules": dict(
        learning_rate=lambda progress: 2 ** -round(10 - 4 * progress),
        actor_learning_rate=lambda progress: 2 ** -round(12 - 6 * progress),
    ),
    "noise": dict(action_noise=NormalActionNoise(np.zeros(1), 0.1 * np.ones(1))),
}


class StandIn:
    """Does what a recording does, by calling the function; Python's part of it has no effect, as in a replay."""

    made = 0

    def __init__(self, function, inputs):
        StandIn.made += 1
        self.function, self.inputs = function, cuda_graphs.clone_all(inputs)

    fits = cuda_graphs.Recording.fits

    @property
    def _inputs(self):
        return self.inputs

    def replay(self, inputs):
        for recorded, new in zip(self.inputs, inputs, strict=True):
            if recorded is not None:
                recorded.copy_(new)
        model = getattr(self.function, "__self__", None)
        attributes = {} if model is None else dict(vars(model))
        outputs = cuda_graphs.clone_all(self.function(*self.inputs))
        if model is not None:
            vars(model).clear()
            vars(model).update(attributes)
        return outputs


@pytest.fixture
def stand_in(monkeypatch):
    """Capture on the CPU, by the stand-in."""
    monkeypatch.setattr(cuda_graph_algorithm, "has_cuda_graphs", lambda device: True)
    monkeypatch.setattr(cuda_graphs, "Recording", StandIn)
    monkeypatch.setattr("sb3_cgp.core.offline.ROUND", 10)
    monkeypatch.setattr(StandIn, "made", 0)


def make_model(**kwargs):
    return CGP("MlpPolicy", "Pendulum-v1", policy_kwargs=dict(net_arch=[16]), **(SMALL | kwargs))


def parameters(model):
    return th.cat([parameter.detach().flatten().cpu() for parameter in model.policy.parameters()])


@pytest.mark.parametrize("name", VARIANTS)
def test_captured_training_is_eager_training(stand_in, name):
    taken = make_model(**VARIANTS[name]).learn(80)
    assert taken._records_steps
    assert StandIn.made > 0
    eager = make_model(**VARIANTS[name], cuda_graphs=False).learn(80)
    assert not eager._records_steps
    assert taken._n_updates == eager._n_updates == 50
    assert th.equal(parameters(taken), parameters(eager))


@pytest.mark.parametrize("changes", [0, 2])
def test_a_recording_that_does_something_else_is_noticed_and_not_used(stand_in, monkeypatch, changes):
    """A graph that does nothing when it is replayed, or everything twice."""

    class Wrong(StandIn):
        def replay(self, inputs):
            outputs = self.function(*inputs)
            for _ in range(changes):
                outputs = self.function(*inputs)
            return cuda_graphs.clone_all(outputs) if changes else tuple(None if each is None else 0 * each for each in outputs)

    class Idle(Wrong):
        def replay(self, inputs):
            model_state = [tensor.clone() for tensor in self.state()]
            outputs = super().replay(inputs)
            cuda_graphs.restore_all(self.state(), model_state)
            return outputs

    model = make_model(target_update_interval=1)
    Idle.state = staticmethod(model._list_state)
    monkeypatch.setattr(cuda_graphs, "Recording", Wrong if changes else Idle)
    with pytest.warns(UserWarning, match="The CUDA graph of a step does not do what the step does"):
        model.learn(60)
    assert all(capture._recording is None for due, capture in model._recorded.items() if due is not None)
    assert model._n_updates == 30
    if changes == 0:
        # Acting, too, was found out; random numbers went on as if nothing had been recorded
        assert th.equal(parameters(model), parameters(make_model(target_update_interval=1, cuda_graphs=False).learn(60)))


def test_every_combination_of_what_is_due_is_recorded_once_and_acting_too(stand_in):
    make_model(policy_delay=2, target_update_interval=3).learn(30 + 6 * (WARM_UP_CALLS + 5))
    # Two by two combinations, and the selection of actions
    assert StandIn.made == 4 + 1


def change_gamma(model):
    model.gamma = 0.5


def change_selector(model):
    model.policy.selector = CEM(2, 8, 3)


def change_selector_in_place(model):
    model.policy.selector.elites = 3


@pytest.mark.parametrize("change", [change_gamma, change_selector, change_selector_in_place])
def test_a_changed_setting_is_recorded_anew(stand_in, change):
    model = make_model(target_update_interval=1).learn(60)
    assert StandIn.made == 2
    model.learn(10, reset_num_timesteps=False)
    assert StandIn.made == 2
    change(model)
    model.learn(10, reset_num_timesteps=False)
    assert StandIn.made == 4
    eager = make_model(target_update_interval=1, cuda_graphs=False).learn(60)
    eager.learn(10, reset_num_timesteps=False)
    change(eager)
    eager.learn(10, reset_num_timesteps=False)
    assert th.equal(parameters(model), parameters(eager))


def test_a_graphs_learning_rate_stays_where_it_is(stand_in):
    model = make_model(learning_rate=lambda progress: 2**-8 if progress > 0.5 else 2**-9).learn(60)
    optimizers = (model.actor.optimizer, model.critic.optimizer)
    rates = [optimizer.param_groups[0]["lr"] for optimizer in optimizers]
    # As a callback might, to no effect: the schedule rules, as it does in SB3
    optimizers[0].param_groups[0]["lr"] = 1.0
    model._current_progress_remaining = 1.0
    model.train(2, 16)
    for optimizer, rate in zip(optimizers, rates, strict=True):
        assert optimizer.param_groups[0]["lr"] is rate
        assert rate.item() == 2**-8


def test_parameters_that_are_set_are_trained_on(stand_in):
    models = [make_model(cuda_graphs=cuda_graphs).learn(60) for cuda_graphs in (True, False)]
    other = make_model(seed=7, cuda_graphs=False).learn(50)
    for model in models:
        # An optimiser keeps the very tensors that it is given
        model.set_parameters(copy.deepcopy(other.get_parameters()))
        model.set_random_seed(3)
        made = StandIn.made
        model.learn(60, reset_num_timesteps=False)
        # What was recorded knows where the optimisers' state was, not where it is
        assert (StandIn.made > made) == model._records_steps
    assert th.equal(*map(parameters, models))


def test_a_captured_model_goes_on_where_nothing_records_steps(stand_in, tmp_path, monkeypatch):
    model = make_model().learn(60)
    model.save(tmp_path / "model")
    monkeypatch.setattr(cuda_graph_algorithm, "has_cuda_graphs", lambda device: False)
    loaded = CGP.load(tmp_path / "model", env=model.get_env())
    for optimizer in (loaded.actor.optimizer, loaded.critic.optimizer):
        (group,) = optimizer.param_groups
        assert type(group["lr"]) is float
        assert group["capturable"] is False
    loaded.learn(60)
    assert loaded._n_updates > model._n_updates


def test_losses_are_logged_when_the_log_is_written(stand_in):
    model = make_model(policy_delay=2).learn(99)
    assert "train/critic_loss" not in model.logger.name_to_value
    model.logger.dump = lambda step: None
    critic_loss, actor_loss = (model._unlogged[f"{name}_loss"] for name in ("critic", "actor"))
    # The actor's is from the step before
    model.dump_logs()
    recorded = model.logger.name_to_value
    assert recorded["train/critic_loss"] == pytest.approx(critic_loss[0].item())
    assert recorded["train/actor_loss"] == pytest.approx(actor_loss[0].item())
    recorded.clear()
    model.dump_logs()
    assert "train/critic_loss" not in recorded


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
    # Mended, it trains on
    model.replay_buffer.rewards[:] = 0.0
    model.train(4, 16)
    model.dump_logs()
    assert not any(map(th.equal, before, model.critic.parameters()))


def test_a_nan_loss_ends_the_training_at_the_next_look_at_it(stand_in):
    model = make_model().learn(60)
    model.replay_buffer.rewards[:] = np.inf
    with pytest.raises(ValueError, match="critic loss was NaN or infinite at gradient step 31"):
        model.learn(5, reset_num_timesteps=False)


def test_a_training_state_has_the_losses_of_recorded_steps_in_its_log(stand_in):
    model = make_model().learn(60)
    model.logger.name_to_value.clear()
    model.train(1, 16)
    (loss,) = model._unlogged["critic_loss"]
    model.get_training_state()
    assert model.logger.name_to_value["train/critic_loss"] == pytest.approx(loss.item())
    # A NaN is reported before a state is saved that would hide it
    model.replay_buffer.rewards[:] = np.nan
    model.train(1, 16)
    with pytest.raises(ValueError, match="The critic loss was NaN or infinite at gradient step 32"):
        model.get_training_state()


def test_a_policy_is_trained_offline_after_every_training_of_its_critics(stand_in):
    model = make_model(policy_training="offline").learn(80)
    calls = []
    model.train_policy = lambda **kwargs: calls.append(kwargs)
    assert model._policy_is_due is False
    model.learn(80, reset_num_timesteps=False)
    assert len(calls) == 1


def test_a_nan_loss_is_checked_every_hundred_steps(stand_in):
    model = make_model().learn(60)
    model.replay_buffer.rewards[:] = np.nan
    with pytest.raises(ValueError, match="critic loss was NaN or infinite at gradient step 31"):
        model.train(200, 16)
    assert model._n_updates == 230
    # Over several calls, too
    for _ in range(69):
        model.train(1, 16)
    with pytest.raises(ValueError, match="critic loss was NaN or infinite at gradient step 231"):
        model.train(1, 16)


def test_a_nan_in_the_offline_training_is_raised_at_once(stand_in):
    model = make_model().learn(60)
    with th.no_grad():
        model.actor.mu[0].weight.fill_(th.nan)
    with pytest.raises(ValueError, match="The actor loss is nan"):
        model.train_policy(max_steps=5)


def test_guards_see_trainings_whose_steps_are_all_replayed(stand_in):
    model = CGP("MlpPolicy", Doubles(), train_freq=(1, "episode"), policy_kwargs=dict(net_arch=[16]), **SMALL).learn(60)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Learnt from the first episode on, although nothing but graphs is replayed
        model.learn(5, reset_num_timesteps=False)
    env = VecNormalize(DummyVecEnv([Doubles]))
    model.set_env(env)
    with pytest.warns(UserWarning, match="has learnt from observations that were not normalised"):
        model.learn(5, reset_num_timesteps=False)
    assert model._learnt_normalized is True


@pytest.mark.parametrize("copy_of", [copy.deepcopy, lambda model: pickle.loads(pickle.dumps(model))], ids=["copy", "pickle"])
def test_a_copied_model_records_anew_and_trains_on_alike(stand_in, copy_of):
    model = make_model().learn(60)
    copied = copy_of(model)
    assert copied._recorded == {}
    made = StandIn.made
    for each in (model, copied):
        each.set_random_seed(3)
        each.learn(20, reset_num_timesteps=False)
    assert StandIn.made > made
    assert th.equal(parameters(model), parameters(copied))


def test_a_synchronizing_step_is_carried_out_as_it_is(stand_in, monkeypatch):
    monkeypatch.setattr(cuda_graphs, "_warm_up", lambda function, inputs, gpu: (function(*inputs), True))
    model = make_model().learn(80)
    assert StandIn.made == 0
    assert th.equal(parameters(model), parameters(make_model(cuda_graphs=False).learn(80)))


def test_models_of_before_the_fused_adam_are_recorded(stand_in):
    old = CGP("MlpPolicy", "Pendulum-v1", policy_kwargs=dict(net_arch=[16], optimizer_kwargs=dict(fused=False)), **SMALL)
    old.learn(60)
    model = make_model(seed=5)
    model.set_parameters(copy.deepcopy(old.get_parameters()))
    assert model._records_steps
    assert model.critic.optimizer.param_groups[0]["fused"] is True
    model.learn(60)


@pytest.mark.parametrize(
    "kwargs",
    [
        dict(optimizer_class=th.optim.SGD),
        dict(optimizer_kwargs=dict(fused=False)),
    ],
)
def test_other_optimizers_are_not_recorded(stand_in, kwargs):
    model = make_model()
    assert model._records_steps
    assert not CGP("MlpPolicy", "Pendulum-v1", policy_kwargs=dict(net_arch=[8]) | kwargs, **SMALL)._records_steps


def test_a_function_is_called_then_recorded_once_then_replayed(monkeypatch):
    monkeypatch.setattr(cuda_graphs, "Recording", StandIn)
    monkeypatch.setattr(StandIn, "made", 0)

    def double(tensor, nothing):
        return 2 * tensor, None

    call = RecordedFunction()
    for value in range(WARM_UP_CALLS + 3):
        doubled, nothing = call(double, th.full((2,), float(value)), None)
        assert doubled.tolist() == [2.0 * value] * 2
        assert nothing is None
        assert StandIn.made == (value >= WARM_UP_CALLS)
    # Another shape or type than the recorded one
    assert call(double, th.ones(3), None)[0].tolist() == [2.0] * 3
    assert call(double, th.ones(2, dtype=th.long), None)[0].dtype == th.long
    assert StandIn.made == 1
    # What was returned before is not overwritten
    first = call(double, th.ones(2), None)[0]
    call(double, th.zeros(2), None)
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


class Stream:
    """A stream that remembers what it was told."""

    def __init__(self, name):
        self.name, self.waited_for = name, []

    def wait_stream(self, other):
        self.waited_for.append(other.name)


@pytest.fixture
def make_believe_gpu(monkeypatch):
    """PyTorch's streams and graphs, as far as they are used, without a GPU behind them: carried out at once."""
    streams = {"current": Stream("usual")}
    side = Stream("side")

    @contextmanager
    def stream(entered):
        left, streams["current"] = streams["current"], entered
        yield
        streams["current"] = left

    @contextmanager
    def graph(graph, stream):
        streams["current"], found.is_recording = stream, True
        # As PyTorch does, not in a `finally`
        yield
        streams["current"], found.is_recording = found.usual, False

    found = SimpleNamespace(streams=streams, usual=streams["current"], side=side, is_recording=False)
    monkeypatch.setattr(cuda_graphs, "gpu_of", lambda inputs: th.device("cuda", 0))
    monkeypatch.setattr(cuda_graphs, "_side_stream", lambda gpu: side)
    for name, replacement in {
        "device": lambda gpu: nullcontext(),
        "current_stream": lambda: streams["current"],
        "set_stream": lambda stream: streams.update(current=stream),
        "stream": stream,
        "graph": graph,
        "CUDAGraph": lambda: SimpleNamespace(replay=lambda: None),
        "get_sync_debug_mode": lambda: 0,
        "set_sync_debug_mode": lambda mode: None,
        "default_generators": [th.default_generator],
    }.items():
        monkeypatch.setattr(th.cuda, name, replacement)
    return found


def test_warm_up_calls_run_on_the_side_stream_in_order(make_believe_gpu):
    seen = []

    def function(tensor):
        seen.append(make_believe_gpu.streams["current"].name)
        return (2 * tensor,)

    outputs, waits = cuda_graphs._warm_up(function, (th.ones(1),), th.device("cuda", 0))
    assert (outputs[0].item(), waits, seen) == (2.0, False, ["side"])
    assert make_believe_gpu.side.waited_for == ["usual"]
    assert make_believe_gpu.usual.waited_for == ["side"]


def test_a_synchronization_is_noticed_and_other_warnings_are_passed_on(make_believe_gpu):
    def function(tensor):
        warnings.warn("Synchronization debug mode is a prototype feature and may miss some", stacklevel=1)
        warnings.warn("called a synchronizing CUDA operation", stacklevel=1)
        warnings.warn("something else", stacklevel=1)
        return (tensor,)

    call = RecordedFunction()
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        call(function, th.ones(1))
    other, waiting = (str(warning.message) for warning in warned)
    assert other == "something else"
    assert re.match("The host synchronizes with the GPU in .*test_cuda_graphs.py, line ", waiting)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for _ in range(WARM_UP_CALLS):
            call(function, th.ones(1))
    assert call._recording is None


def test_a_recording_is_made_on_the_side_stream(make_believe_gpu):
    seen = []

    def function(tensor, nothing):
        seen.append(make_believe_gpu.streams["current"].name)
        return (2 * tensor,)

    recording = cuda_graphs.Recording(function, (th.ones(1), None))
    assert seen == ["side"]
    assert make_believe_gpu.streams["current"] is make_believe_gpu.usual
    assert recording.fits((th.zeros(1), None))
    assert not recording.fits((th.zeros(1), th.zeros(1)))
    assert not recording.fits((th.zeros(1),))
    # This graph does nothing when replayed: what it returns is as it was recorded
    assert recording.replay((th.zeros(1), None))[0].item() == 2.0
    assert recording._inputs[0].item() == 0.0


def test_what_cannot_be_recorded_is_carried_out(make_believe_gpu):
    def function(tensor):
        if make_believe_gpu.is_recording:
            raise RuntimeError("operation not permitted when stream is capturing\nSearch for it")
        return (2 * tensor,)

    call = RecordedFunction()
    for _ in range(WARM_UP_CALLS):
        call(function, th.ones(1))
    with pytest.warns(UserWarning, match="The reason: operation not permitted when stream is capturing$"):
        assert call(function, th.ones(1))[0].item() == 2.0
    assert make_believe_gpu.streams["current"] is make_believe_gpu.usual
    # Random numbers wait for the end of a recording: another one has ended
    assert not make_believe_gpu.is_recording
    assert call(function, th.full((1,), 3.0))[0].item() == 6.0
    assert call._recording is None


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
    with pytest.warns(UserWarning, match="The host synchronizes with the GPU in"):
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
