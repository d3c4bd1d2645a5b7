"""Frozen parameters stay frozen in a resumed training; optimizers and schedules that `resume` cannot make are named."""

from copy import deepcopy

import pytest
import torch as th
from stable_baselines3 import DQN, SAC, TD3
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor
from stable_baselines3.common.utils import FloatSchedule, LinearSchedule
from trainings import Do, Interruption, parameters_equal

from sb3_cgp import CGP, MlpPolicy
from sb3_cgp.resumption import TrainingCheckpointCallback, resumable
from sb3_cgp.resumption.store import StateStore

ARGUMENTS = dict(learning_starts=20, buffer_size=150, batch_size=8, seed=0, device="cpu")
ALGORITHMS = [resumable(TD3), CGP]


class Linear(BaseFeaturesExtractor):
    def __init__(self, observation_space):
        super().__init__(observation_space, 4)
        self.layer = th.nn.Linear(observation_space.shape[0], 4)

    def forward(self, observations):
        return self.layer(observations)


def make_model(algorithm, **arguments):
    arguments = ARGUMENTS | dict(policy_kwargs=dict(net_arch=[8, 8])) | arguments
    return algorithm(arguments.pop("policy", "MlpPolicy"), arguments.pop("env", "Pendulum-v1"), **arguments)


def with_frozen_first_layers(model):
    for network in (model.actor, model.critic):
        for parameter in list(network.parameters())[:2]:
            parameter.requires_grad_(False)
    return model


def raise_interruption():
    raise Interruption


def interrupted(model, folder, step=57):
    with pytest.raises(Interruption):
        model.learn(90, [TrainingCheckpointCallback(10, folder), Do(step, raise_interruption)])


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_parameters_that_were_frozen_are_not_trained_by_the_resumed_training(algorithm, tmp_path):
    straight = with_frozen_first_layers(make_model(algorithm)).learn(90)
    interrupted(with_frozen_first_layers(make_model(algorithm)), tmp_path)
    resumed = algorithm.resume(tmp_path, "Pendulum-v1").learn(90)
    assert parameters_equal(resumed, straight)
    initial = make_model(algorithm)
    assert th.equal(resumed.actor.mu[0].weight, initial.actor.mu[0].weight)
    assert not th.equal(resumed.actor.mu[2].weight, initial.actor.mu[2].weight)


def test_parameters_that_were_released_are_trained_by_the_resumed_training(tmp_path):
    class Frozen(MlpPolicy):
        def __init__(self, *args, **kwargs):
            super().__init__(*args, **kwargs)
            self.actor.requires_grad_(False)

    model = make_model(CGP, policy=Frozen)
    model.actor.requires_grad_(True)
    interrupted(model, tmp_path)
    resumed = CGP.resume(tmp_path, "Pendulum-v1")
    before = resumed.actor.mu[0].weight.clone()
    assert not th.equal(resumed.learn(90).actor.mu[0].weight, before)


def test_a_frozen_features_extractor_that_was_exchanged_is_resumed(tmp_path):
    """The optimizers keep the parameters of the former ones, which nothing trains any more."""

    def with_trained_extractors(model):
        th.manual_seed(1)
        extractor = Linear(model.observation_space).requires_grad_(False)
        for network in (model.actor, model.actor_target, model.critic, model.critic_target):
            network.features_extractor = deepcopy(extractor)
        return model

    arguments = dict(policy_kwargs=dict(net_arch=[8], features_extractor_class=Linear))
    straight = with_trained_extractors(make_model(CGP, **arguments)).learn(90)
    interrupted(with_trained_extractors(make_model(CGP, **arguments)), tmp_path)
    assert parameters_equal(CGP.resume(tmp_path, "Pendulum-v1").learn(90), straight)


OPTIMIZERS = {
    "SGD of 6 parameters": lambda actor: th.optim.SGD(actor.parameters(), lr=1e-3),
    "AdamW of 6 parameters": lambda actor: th.optim.AdamW(actor.parameters(), lr=1e-3),
    "Adam of 2 parameters": lambda actor: th.optim.Adam(actor.mu[-2].parameters(), lr=1e-3),
    "Adam of 6 parameters": lambda actor: th.optim.Adam(reversed(list(actor.parameters())), lr=1e-3),
}


@pytest.mark.parametrize("optimizer", OPTIMIZERS)
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_an_optimizer_that_cannot_be_resumed_is_refused_before_the_first_step(algorithm, optimizer, tmp_path):
    model = make_model(algorithm)
    model.actor.optimizer = OPTIMIZERS[optimizer](model.actor)
    message = f"`model.actor.optimizer` is {optimizer}, but the policy makes .*Adam of 6 .*`policy_kwargs=.*`requires_grad_"
    with pytest.raises(ValueError, match=message):
        model.learn(90, TrainingCheckpointCallback(20, tmp_path))
    assert model.num_timesteps == 0
    model.learn(30)


def test_another_implementation_of_adam_is_refused_as_it_rounds_otherwise(tmp_path):
    model = make_model(CGP)
    model.critic.optimizer = th.optim.Adam(model.critic.parameters(), lr=1e-3)
    with pytest.raises(ValueError, match=r"`model.critic.optimizer` is Adam of .*, but the policy makes fused Adam of"):
        model.learn(90, TrainingCheckpointCallback(20, tmp_path))


def test_an_optimizer_that_is_exchanged_within_the_training_is_refused_at_the_next_state(tmp_path):
    model = make_model(CGP)

    def exchange():
        model.actor.optimizer = th.optim.SGD(model.actor.parameters(), lr=1e-3)

    with pytest.raises(ValueError, match=r"`model.actor.optimizer` is SGD"):
        model.learn(90, [TrainingCheckpointCallback(20, tmp_path), Do(50, exchange)])
    assert StateStore(tmp_path).steps() == [20, 40]
    assert CGP.resume(tmp_path, "Pendulum-v1").learn(90).num_timesteps == 90


SCHEDULES = {
    "lr_schedule": (CGP, FloatSchedule(1e-5)),
    "exploration_schedule": (resumable(DQN), LinearSchedule(0.5, 0.1, 1.0)),
}


@pytest.mark.parametrize("name", SCHEDULES)
def test_a_schedule_that_is_set_on_the_model_and_will_be_lost_is_warned_of(name, tmp_path):
    algorithm, schedule = SCHEDULES[name]
    model = make_model(algorithm, env="CartPole-v1" if algorithm is not CGP else "Pendulum-v1")
    message = rf"`model.{name}` and `.*` disagree.*: set both alike on the model"
    with pytest.warns(UserWarning, match=message):
        model.learn(90, [TrainingCheckpointCallback(20, tmp_path / "state"), Do(50, lambda: setattr(model, name, schedule))])
    with pytest.warns(UserWarning, match=message):
        model.save(tmp_path / "model")


@pytest.mark.parametrize("schedule", [FloatSchedule(1e-5), lambda _: 1e-5])
@pytest.mark.filterwarnings("error")
def test_a_schedule_that_agrees_with_the_learning_rate_is_not_warned_of(schedule, tmp_path):
    model = make_model(CGP)
    model.learning_rate, model.lr_schedule = 1e-5, schedule
    model.learn(30, TrainingCheckpointCallback(10, tmp_path / "state"))
    assert CGP.resume(tmp_path / "state", "Pendulum-v1").lr_schedule(0.5) == 1e-5


@pytest.mark.parametrize("rate", [1e-3, "lin_1e-3", lambda remaining: 1e-3 * remaining], ids=["number", "text", "function"])
@pytest.mark.filterwarnings("error")
def test_a_learning_rate_in_each_form_is_saved_without_a_warning(rate, tmp_path):
    make_model(CGP, learning_rate=rate).save(tmp_path / "model")


@pytest.mark.filterwarnings("error")
def test_saving_calls_no_schedule_of_the_users(tmp_path):
    calls = []

    def decaying(remaining):
        calls.append(remaining)
        return 1e-3 * 0.99 ** len(calls)

    for algorithm in (CGP, resumable(TD3)):
        model = make_model(algorithm, learning_rate=decaying).learn(30)
        n_calls = len(calls)
        model.save(tmp_path / "model")
        assert len(calls) == n_calls


def test_a_learning_rate_that_is_set_is_resumed(tmp_path):
    def slow_down(model):
        model.learning_rate = 1e-5

    straight = make_model(CGP)
    straight.learn(90, Do(30, lambda: slow_down(straight)))
    stopped = make_model(CGP)
    with pytest.raises(Interruption):
        stopped.learn(
            90, [TrainingCheckpointCallback(10, tmp_path), Do(30, lambda: slow_down(stopped)), Do(57, raise_interruption)]
        )
    resumed = CGP.resume(tmp_path, "Pendulum-v1").learn(90)
    assert parameters_equal(resumed, straight)
    # A copy has schedules of its own
    deepcopy(resumed).learn(20, TrainingCheckpointCallback(20, tmp_path / "copy"))


class OwnOptimizers(MlpPolicy):
    """Makes an optimizer of another class, of a part of the actor."""

    def _build(self, lr_schedule):
        super()._build(lr_schedule)
        self.actor.optimizer = th.optim.SGD(self.actor.mu[-2].parameters(), lr=1e-3)


@pytest.mark.parametrize(
    ("algorithm", "arguments"),
    [
        (SAC, dict(policy_kwargs=dict(net_arch=[8], share_features_extractor=True))),
        (DQN, dict(env="CartPole-v1")),
        (TD3, dict(policy_kwargs=dict(optimizer_class=th.optim.SGD))),
        (CGP, dict(policy=OwnOptimizers)),
        (CGP, dict(policy_kwargs=dict(net_arch=[8], optimizer_kwargs=dict(fused=False)))),
        (CGP, dict(policy_kwargs=dict(features_extractor_class=FlattenExtractor, share_features_extractor=True))),
    ],
    ids=str,
)
def test_the_policies_own_optimizers_are_saved_and_resumed(algorithm, arguments, tmp_path):
    algorithm = resumable(algorithm)
    interrupted(make_model(algorithm, **arguments), tmp_path)
    resumed = algorithm.resume(tmp_path, arguments.get("env", "Pendulum-v1")).learn(90)
    assert parameters_equal(resumed, make_model(algorithm, **arguments).learn(90))
