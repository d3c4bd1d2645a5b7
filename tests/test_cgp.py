"""CGP as a user of SB3 meets it: its defaults, variants, acting, seeding, and its policies."""

import inspect
import math
from copy import deepcopy

import numpy as np
import pytest
import torch as th
from small_models import VARIANTS, make_model, same_parameters, step_without_learning
from stable_baselines3 import TD3
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.utils import LinearSchedule

from sb3_cgp import CEM, CGP, CGPPolicy


def test_defaults_are_those_of_appendix_b():
    defaults = {name: parameter.default for name, parameter in inspect.signature(CGP.__init__).parameters.items()}
    appendix_b = dict(cem_iterations=2, cem_samples=64, cem_elites=6, learning_rate=1e-3, batch_size=128, gamma=0.99,
                      tau=0.005, target_update_interval=2, target_policy_noise=0.2, target_noise_clip=0.5,
                      action_noise=None, learning_starts=10_000, buffer_size=1_000_000, policy_delay=1,
                      policy_loss="cgp", policy_training="online", actor_learning_rate=None)  # fmt: skip
    assert {name: defaults[name] for name in appendix_b} == appendix_b
    model = CGP("MlpPolicy", "Pendulum-v1", buffer_size=10)
    assert (model.policy.selector.iterations, model.policy.selector.samples, model.policy.selector.elites) == (2, 64, 6)
    assert [parameter.shape[0] for parameter in model.actor.parameters()] == [256, 256, 256, 256, 1, 1]
    assert len(model.critic.q_networks) == 2
    assert model.actor.optimizer.defaults["weight_decay"] == 0
    assert (model.inference, model.policy.inference) == (None, "actor")


def test_takes_every_argument_of_td3():
    ours, theirs = (inspect.signature(algorithm.__init__).parameters for algorithm in (CGP, TD3))
    assert set(theirs) <= set(ours)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.usefixtures("short_policy_training")
def test_every_variant_trains_saves_loads_and_predicts_the_same(variant, tmp_path):
    model = make_model(**VARIANTS[variant]).learn(100)
    assert model.logger.name_to_value is not None
    assert model._n_updates == 50
    observations = np.array([model.observation_space.sample() for _ in range(5)])
    model.save(tmp_path / "model")
    loaded = CGP.load(tmp_path / "model")
    assert same_parameters(model, loaded)
    th.manual_seed(0)
    actions, _ = model.predict(observations)
    th.manual_seed(0)
    assert np.array_equal(loaded.predict(observations)[0], actions)
    assert actions.shape == (5, 1)
    assert loaded.predict(observations[0])[0].shape == (1,)


class Recorder(BaseCallback):
    """Remembers, at every step, what was done and what the model would have predicted."""

    def __init__(self):
        super().__init__()
        self.done, self.predicted = [], []

    def _on_step(self):
        self.done.append(self.locals["buffer_actions"].copy())
        self.predicted.append(self.model.predict(self.model._last_obs)[0].copy())
        return True


def test_rollouts_act_by_cem_while_predict_asks_the_actor():
    class Counting(CEM):
        calls = 0

        def select(self, score, n_states, *args, **kwargs):
            Counting.calls += n_states == 1
            return super().select(score, n_states, *args, **kwargs)

    recorder = Recorder()
    model = make_model(policy_kwargs=dict(net_arch=[16], selector=Counting(2, 8, 2)))
    model.learn(150, callback=recorder)
    # One selection per step after the warm-up, none for the 150 predictions
    assert Counting.calls == 100
    last_observation = model.policy.obs_to_tensor(model._last_obs)[0]
    actor_action = model.policy.unscale_action(model.actor(last_observation).detach().numpy())
    assert np.allclose(model.predict(model._last_obs)[0], actor_action)


def test_bootstrap_actions_are_selected_on_the_target_critic_and_the_others_on_the_critic():
    asked = []

    class Asking(CEM):
        """Keeps the values of actions of 0."""

        def select(self, score, n_states, action_dim, device="cpu"):
            asked.append(score(th.zeros(n_states, 1, action_dim)))
            return super().select(score, n_states, action_dim, device)

    arguments = dict(cem_dtype="float32", learning_rate=1e-2, tau=0.1, diagnostics=False)
    model = make_model(**arguments, policy_kwargs=dict(net_arch=[16], selector=Asking())).learn(71)
    critic, target = model.critic, deepcopy(model.critic_target)
    asked.clear()
    observations = step_without_learning(model)
    for values, of_choice, selects, other in zip(
        asked, observations, (critic, target, critic), (target, critic, target), strict=True
    ):
        zeros = th.zeros(len(of_choice), 1)
        assert th.allclose(values, selects.q1_forward(of_choice, zeros), atol=1e-5)
        assert not th.allclose(values, other.q1_forward(of_choice, zeros), atol=1e-2)


def test_eval_callback_scores_the_actor_within_learn(tmp_path):
    class Constant(CEM):
        """Would score the worst torque, were it asked."""

        def select(self, score, n_states, action_dim, device="cpu"):
            selection = super().select(score, n_states, action_dim, device)
            return selection._replace(actions=th.ones_like(selection.actions))

    eval_env = make_vec_env("Pendulum-v1", seed=5)
    callback = EvalCallback(eval_env, eval_freq=120, n_eval_episodes=2, log_path=tmp_path, verbose=0)
    model = make_model(learning_rate=0.0, policy_kwargs=dict(net_arch=[16], selector=Constant()))
    model.learn(120, callback=callback)
    # With a learning rate of 0 the actor is still the one that was scored
    eval_env.seed(5)
    returns, _ = evaluate_policy(model.actor, eval_env, n_eval_episodes=2, return_episode_rewards=True)
    assert callback.evaluations_results[0] == pytest.approx(returns)
    # While the rollout acted by the selector
    assert (model.replay_buffer.actions[50:120] == 1.0).all()


@pytest.mark.parametrize("inference", ["actor", "averaged_actor", "cem"])
def test_inference_asks_what_it_says(inference, tmp_path):
    model = make_model(inference=inference, tau=0.5).learn(100)
    observations = np.array([model.observation_space.sample() for _ in range(4)])
    tensors = model.policy.obs_to_tensor(observations)[0]
    th.manual_seed(0)
    expected = {
        "actor": lambda: model.actor(tensors),
        "averaged_actor": lambda: model.actor_target(tensors),
        "cem": lambda: model.policy.select_actions(tensors, model.critic).actions,
    }[inference]()
    th.manual_seed(0)
    actions = model.predict(observations, deterministic=True)[0]
    assert np.allclose(actions, model.policy.unscale_action(expected.detach().numpy()))
    # The choice can be changed on loading, and travels with a policy that is saved alone
    model.save(tmp_path / "model")
    assert CGP.load(tmp_path / "model", inference="averaged_actor").policy.inference == "averaged_actor"
    model.policy.save(tmp_path / "policy")
    assert CGPPolicy.load(tmp_path / "policy").inference == inference


def test_without_a_policy_loss_cem_acts_and_no_actor_is_trained():
    model = make_model(policy_loss=None)
    before = [parameter.clone() for parameter in model.actor.parameters()]
    model.learn(100)
    assert (model.inference, model.policy.inference) == (None, "cem")
    assert all(th.equal(a, b) for a, b in zip(before, model.actor.parameters(), strict=True))


def test_same_seed_same_parameters_to_the_bit():
    models = [make_model(seed=seed).learn(150) for seed in (1, 1, 2)]
    assert same_parameters(models[0], models[1])
    assert not same_parameters(models[0], models[2])


@pytest.mark.parametrize("how", ["constructor", "attribute", "class"])
def test_a_policy_subclass_keeps_a_selector_of_its_own(how, tmp_path):
    own = CEM(1, 3, 1)

    class Own(CGPPolicy):
        def __init__(self, *args, **kwargs):
            super().__init__(*args, **kwargs | (dict(selector=own) if how == "constructor" else {}))
            if how == "attribute":
                self.selector = own

    if how == "class":
        Own.make_score = lambda self, q_network, features: lambda actions: actions.sum(dim=2)
        Own.__init__ = lambda self, *args, **kwargs: CGPPolicy.__init__(self, *args, **kwargs | dict(selector=own))
    model = make_model(policy=Own).learn(60)
    assert model.policy.selector is own
    # And one that has none gets CEM by the arguments
    assert repr(make_model(cem_iterations=3).policy.selector).startswith("CEM(iterations=3, samples=8")


class Caching(BaseFeaturesExtractor):
    """Keeps a tensor that it computed at its first forward."""

    def __init__(self, observation_space):
        super().__init__(observation_space, 3)
        self.scale = None

    def forward(self, observations):
        if self.scale is None:
            self.scale = th.ones_like(observations[:1]) * 2
        return observations * self.scale


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.usefixtures("short_policy_training")
def test_a_module_may_keep_a_tensor_of_its_first_forward(variant):
    kwargs = dict(net_arch=[16], features_extractor_class=Caching)
    model = make_model(**VARIANTS[variant], policy_kwargs=kwargs, learning_starts=5)
    # Acting comes first
    model.policy.set_training_mode(False)
    for inference in ("cem", "actor"):
        with model.policy.acting_by(inference):
            model.predict(model.observation_space.sample())
    assert model.learn(20)._n_updates == 15


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.usefixtures("short_policy_training")
def test_diagnostics_do_not_change_the_training(variant, monkeypatch):
    monkeypatch.setattr("sb3_cgp.diagnostics.INTERVAL", 20)
    arguments = dict(VARIANTS[variant], batch_size=4, action_noise=NormalActionNoise(np.zeros(1), np.ones(1)))
    models = [make_model(**arguments, diagnostics=diagnostics).learn(120) for diagnostics in (True, False)]
    assert ["train/cem_std" in model.logger.name_to_value for model in models] == [variant[4:] != "Offline", False]
    assert same_parameters(*models)
    assert all(model.replay_buffer.pos == 120 for model in models)
    assert np.array_equal(*(model.replay_buffer.actions for model in models))


def test_learning_rates_are_separate_and_follow_their_schedules():
    model = make_model(learning_rate=LinearSchedule(1e-2, 0.0, 1.0), actor_learning_rate="lin_4e-3")
    rates = []

    class Rates(BaseCallback):
        def _on_step(self):
            optimizers = (self.model.critic.optimizer, self.model.actor.optimizer)
            rates.append(tuple(optimizer.param_groups[0]["lr"] for optimizer in optimizers))
            return True

    model.learn(100, callback=Rates())
    assert rates[-1] == pytest.approx((1e-2 * 0.01, 4e-3 * 0.01))
    # `train` set these at step 76, when 24 of 100 steps remained
    assert rates[76] == pytest.approx((1e-2 * 0.24, 4e-3 * 0.24))
    assert make_model(learning_rate="lin_1e-2").actor_lr_schedule(0.25) == pytest.approx(2.5e-3)
    for actor_learning_rate in (None, 1e-3, lambda progress: 1e-3):
        model = make_model(learning_rate=1e-3, actor_learning_rate=actor_learning_rate)
        assert model.actor_lr_schedule(0.5) == 1e-3


@pytest.mark.parametrize("rate", [lambda remaining: 2e-3 * remaining, lambda remaining: 2e-3 * math.sqrt(remaining)])
@pytest.mark.parametrize("name", ["learning_rate", "actor_learning_rate"])
def test_a_schedule_ends_with_the_planned_steps_even_if_the_last_rollout_goes_on(name, rate):
    """Beyond them the first would be negative, and the second is not defined."""
    model = make_model(train_freq=(1, "episode"), gradient_steps=10, **{name: rate})
    model.learn(250)
    assert model.num_timesteps == 400
    optimizer = model.actor.optimizer if name == "actor_learning_rate" else model.critic.optimizer
    assert optimizer.param_groups[0]["lr"] == 0


@pytest.mark.parametrize(("given", "fused"), [(None, True), (dict(weight_decay=0.1), True), (dict(fused=False), False)])
def test_adam_is_fused_unless_the_user_says_otherwise(given, fused):
    model = make_model(policy_kwargs=dict(net_arch=[8], optimizer_kwargs=given))
    for network in (model.actor, model.critic):
        assert network.optimizer.defaults["fused"] is fused
    sgd = make_model(policy_kwargs=dict(net_arch=[8], optimizer_class=th.optim.SGD))
    assert sgd.actor.optimizer.defaults.get("fused") is None


def test_no_selector_is_cem_as_it_was_asked_for():
    assert make_model(cem_iterations=4, policy_kwargs=dict(selector=None)).policy.selector.iterations == 4
