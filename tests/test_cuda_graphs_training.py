"""
Gradient steps as CUDA graphs. Without a GPU, a stand-in for the graph carries the recorded function out again on the memory
that it was recorded with: everything but PyTorch's CUDA graphs is tested on any machine, and these in test_cuda_graphs_gpu.py.
"""

import copy
import pickle
import warnings

import pytest
import torch as th
from environments import Doubles
from graph_models import SMALL, VARIANTS, StandIn, make_model, parameters
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_cgp import CEM, CGP
from sb3_cgp.fast import cuda_graph_algorithm, cuda_graphs
from sb3_cgp.fast.cuda_graphs import WARM_UP_CALLS


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


def change_selector(model):
    model.policy.selector = CEM(2, 8, 3)


def change_selector_in_place(model):
    model.policy.selector.elites = 3


def freeze_a_layer(model):
    next(model.critic.parameters()).requires_grad_(False)


def change_weight_decay(model):
    for group in model.critic.optimizer.param_groups:
        group["weight_decay"] = 0.1


def setting(**values):
    """Set attributes of the model, as a callback may."""

    def change(model):
        for name, value in values.items():
            setattr(model, name, value)

    return change


CHANGES = {
    "gamma": setting(gamma=0.5),
    "tau": setting(tau=0.5),
    "noise": setting(target_policy_noise=0.4),
    "clip": setting(target_noise_clip=0.05),
    "loss": setting(policy_loss="qgp"),
    "batch size": setting(batch_size=5),
    "data type": setting(cem_dtype="bfloat16"),
    "proposals": lambda model: setattr(model.policy, "actor_proposes", False),
    "selector": change_selector,
    "selector in place": change_selector_in_place,
    "frozen layer": freeze_a_layer,
    "weight decay": change_weight_decay,
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
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


def test_a_policy_is_trained_offline_after_every_training_of_its_critics(stand_in):
    model = make_model(policy_training="offline").learn(80)
    calls = []
    model.train_policy = lambda **kwargs: calls.append(kwargs)
    assert model._policy_is_due is False
    model.learn(80, reset_num_timesteps=False)
    assert len(calls) == 1


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
