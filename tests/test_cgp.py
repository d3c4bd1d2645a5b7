"""CGP as a user of SB3 meets it: acting, variants, saving, loading, seeding, and the errors for bad input."""

import inspect
import json
import warnings
import zipfile

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import TD3
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback, StopTrainingOnMaxEpisodes
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.noise import NormalActionNoise, VectorizedActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.td3.policies import TD3Policy

from sb3_cgp import CEM, CGP, CGPPolicy, CnnPolicy, MultiInputPolicy

VARIANTS = {
    "CGP-Online": dict(),
    "CGP-Offline": dict(policy_training="offline"),
    "QGP-Online": dict(policy_loss="qgp"),
    "QGP-Offline": dict(policy_loss="qgp", policy_training="offline"),
    "CEM": dict(policy_loss=None),
    "CGP-Light": dict(cem_start="actor", cem_iterations=1),
}


def make_model(env="Pendulum-v1", policy="MlpPolicy", **kwargs):
    """A model small enough to train in a second."""
    arguments = dict(learning_starts=50, buffer_size=1_000, batch_size=16, cem_samples=8, cem_elites=2, seed=0)
    arguments["policy_kwargs"] = dict(net_arch=[16])
    arguments.update(kwargs)
    return CGP(policy, env, **arguments)


def same_parameters(model, other):
    state, other_state = model.policy.state_dict(), other.policy.state_dict()
    return state.keys() == other_state.keys() and all(th.equal(state[key], other_state[key]) for key in state)


@pytest.fixture
def short_policy_training(monkeypatch):
    """Rounds of 10 steps, so that offline training takes a moment."""
    monkeypatch.setattr("sb3_cgp.core.offline.ROUND", 10)


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


@pytest.mark.usefixtures("short_policy_training")
class TestOffline:
    """Training the policy when the critics are learnt."""

    class Watcher(BaseCallback):
        def __init__(self, stop_after=10**9):
            super().__init__()
            self.stop_after, self.inferences, self.actors, self.ends = stop_after, [], [], 0

        def _on_step(self):
            self.inferences.append(self.model.policy.inference)
            self.actors.append(next(self.model.actor.parameters()).detach().clone())
            return self.n_calls < self.stop_after

        def _on_training_end(self):
            self.ends += 1

    @pytest.mark.parametrize("policy_loss", ["cgp", "qgp"])
    def test_the_policy_rests_while_the_critics_learn_and_then_learns_while_they_rest(self, policy_loss):
        critics = []

        class Critics(self.Watcher):
            def _on_training_end(self):
                critics.append([parameter.clone() for parameter in self.model.critic.parameters()])

        watcher = Critics()
        model = make_model(policy_loss=policy_loss, policy_training="offline").learn(100, callback=watcher)
        assert watcher.inferences[:100] == ["cem"] * 100
        assert all(th.equal(actor, watcher.actors[0]) for actor in watcher.actors[:100])
        # The policy's own training: at least the plateau's 6 rounds, scored by the actor itself
        assert len(watcher.actors) >= 160
        assert set(watcher.inferences[100:]) == {"actor"}
        assert not any(th.equal(old, new) for old, new in zip(watcher.actors[100:], watcher.actors[101:], strict=False))
        assert all(th.equal(a, b) for a, b in zip(*critics, strict=True))
        assert model.policy.inference == "actor"

    def test_a_callback_that_counts_episodes_sees_none_in_the_policys_training(self):
        callback = StopTrainingOnMaxEpisodes(max_episodes=2)
        model = make_model(policy_training="offline").learn(600, callback=callback)
        assert model.num_timesteps == 400
        assert callback.n_episodes == 2
        # It stopped the policy's training too, at once
        assert model.policy.inference == "cem"

    def test_a_callback_can_stop_it(self):
        for stop_after, inference in ((107, "cem"), (117, "actor")):
            watcher = self.Watcher(stop_after)
            model = make_model(policy_training="offline").learn(100, callback=watcher)
            assert watcher.n_calls == stop_after
            assert watcher.ends == 2
            # Less than a round makes no policy
            assert model.policy.inference == inference

    def test_a_model_that_a_callback_saves_acts_as_it_was_scored(self, tmp_path):
        class Saver(self.Watcher):
            def _on_step(self):
                self.model.save(tmp_path / str(self.n_calls))
                return super()._on_step()

        make_model(policy_training="offline").learn(100, callback=Saver(stop_after=115))
        assert CGP.load(tmp_path / "100").policy.inference == "cem"
        assert CGP.load(tmp_path / "105").policy.inference == "actor"

    def test_without_a_step_of_the_critics_the_policy_rests(self, tmp_path):
        make_model(policy_training="offline").learn(100).save(tmp_path / "model")
        model = CGP.load(tmp_path / "model", env=gym.make("Pendulum-v1"))
        before = next(model.actor.parameters()).clone()
        model.learn(10)
        assert th.equal(before, next(model.actor.parameters()))

    def test_an_error_in_it_leaves_cem_to_act(self):
        class Broken(self.Watcher):
            def _on_step(self):
                if self.n_calls > 105:
                    raise KeyboardInterrupt
                return True

        model = make_model(policy_training="offline")
        with pytest.raises(KeyboardInterrupt):
            model.learn(100, callback=Broken())
        assert model.policy.inference == "cem"

    def test_can_be_called_on_a_loaded_model_with_a_loaded_buffer(self, tmp_path):
        # Interrupted before the policy's training
        model = make_model(policy_training="offline")
        OffPolicyAlgorithm.learn(model, 100)
        model.save(tmp_path / "model")
        model.save_replay_buffer(tmp_path / "buffer")

        loaded = CGP.load(tmp_path / "model")
        assert loaded.policy.inference == "cem"
        with pytest.raises(ValueError, match=r"`replay_buffer` is .* must be filled"):
            loaded.train_policy()
        loaded.load_replay_buffer(tmp_path / "buffer")
        loaded.train_policy(progress_bar=True)
        assert loaded.policy.inference == "actor"
        loaded.save(tmp_path / "trained")
        assert CGP.load(tmp_path / "trained").policy.inference == "actor"

    def test_a_policy_that_a_callback_stops_too_early_is_warned_of(self):
        with pytest.warns(UserWarning, match="A callback stopped the policy's training after 7 steps: CEM acts"):
            make_model(policy_training="offline").learn(100, callback=self.Watcher(stop_after=107))

    def test_a_model_trained_online_acts_by_its_actor_when_it_is_loaded_to_train_offline(self, tmp_path):
        make_model().learn(100).save(tmp_path / "model")
        assert CGP.load(tmp_path / "model", policy_training="offline").policy.inference == "actor"
        assert CGP.load(tmp_path / "model", policy_loss=None).policy.inference == "cem"
        make_model().save(tmp_path / "untrained")
        assert CGP.load(tmp_path / "untrained", policy_training="offline").policy.inference == "cem"

    @pytest.mark.parametrize("policy_loss", ["cgp", "qgp"])
    def test_critics_with_batch_norm_stay_as_they_are(self, policy_loss):
        class Normalizing(BaseFeaturesExtractor):
            def __init__(self, observation_space):
                super().__init__(observation_space, 3)
                self.norm = th.nn.BatchNorm1d(3)

            def forward(self, observations):
                return self.norm(observations)

        kwargs = dict(net_arch=[16], features_extractor_class=Normalizing)
        model = make_model(policy_loss=policy_loss, policy_kwargs=kwargs).learn(100)
        before = {name: value.clone() for name, value in model.critic.state_dict().items()}
        actor = {name: value.clone() for name, value in model.actor.state_dict().items()}
        model.train_policy(max_steps=30)
        assert all(th.equal(before[name], value) for name, value in model.critic.state_dict().items())
        assert not any(th.equal(actor[name], value) for name, value in model.actor.state_dict().items())

    def test_a_shared_extractor_is_refused_as_it_would_change_the_critics(self):
        model = make_model(policy_kwargs=dict(net_arch=[16], share_features_extractor=True)).learn(60)
        with pytest.raises(ValueError, match="`share_features_extractor` is True, but must be False to train a policy apart"):
            model.train_policy()

    def test_callbacks_see_the_locals_of_an_online_training(self):
        class Locals(self.Watcher):
            def __init__(self):
                super().__init__()
                self.started, self.stepped = [], []

            def _on_training_start(self):
                self.started.append(dict(self.locals))

            def _on_step(self):
                self.stepped.append(dict(self.locals))
                return True

        watcher = Locals()
        env = make_vec_env("Pendulum-v1", n_envs=2)
        model = make_model(env, policy_training="offline").learn(100, callback=watcher, progress_bar=True)
        online, offline = watcher.started
        assert set(online) <= set(offline)
        assert offline["total_timesteps"] - model.num_timesteps == 2 * 100_000
        first, last = watcher.stepped[0], watcher.stepped[-1]
        # But for the names of loops that have not begun at a rollout's first step
        assert set(first) <= set(last)
        for name in ("rewards", "dones", "actions", "buffer_actions", "new_obs"):
            assert (last[name].shape, last[name].dtype) == (first[name].shape, first[name].dtype), name
        assert not last["rewards"].any()
        assert not last["dones"].any()
        assert last["infos"] == [{}, {}]
        assert last["env"] is model.get_env()

    def test_an_online_policy_can_be_trained_further(self):
        model = make_model().learn(100)
        before = next(model.actor.parameters()).clone()
        model.train_policy(batch_size=4)
        assert not th.equal(before, next(model.actor.parameters()))

    def test_says_when_the_steps_did_not_suffice(self):
        model = make_model().learn(100)
        with pytest.warns(UserWarning, match="max_steps=20"):
            model.train_policy(max_steps=20)

    def test_needs_a_policy_loss_and_steps(self):
        model = make_model(policy_loss=None).learn(100)
        with pytest.raises(ValueError, match="`policy_loss` is None, but must be one of 'cgp', 'qgp'"):
            model.train_policy()
        with pytest.raises(ValueError, match="`max_steps` is 0"):
            make_model().train_policy(max_steps=0)


def test_same_seed_same_parameters_to_the_bit():
    models = [make_model(seed=seed).learn(150) for seed in (1, 1, 2)]
    assert same_parameters(models[0], models[1])
    assert not same_parameters(models[0], models[2])


def test_loading_changes_arguments_and_checks_them(tmp_path):
    model = make_model().learn(100)
    model.save(tmp_path / "model")
    loaded = CGP.load(tmp_path / "model", cem_iterations=4, cem_elites=3)
    assert (loaded.policy.selector.iterations, loaded.policy.selector.elites) == (4, 3)
    with pytest.raises(ValueError, match="`tau` is -3"):
        CGP.load(tmp_path / "model", tau=-3)
    with pytest.raises(ValueError, match="`policy_delay` is 'banana', but must be an integer >= 1"):
        CGP.load(tmp_path / "model", policy_delay="banana")
    assert CGP.load(tmp_path / "model", inference=None).policy.inference == "actor"
    # As rl_zoo3's enjoy does
    assert CGP.load(tmp_path / "model", custom_objects=dict(learning_rate=0.0, lr_schedule=lambda _: 0.0))


@pytest.mark.parametrize(
    ("saved", "loaded", "inference"),
    [
        (dict(), dict(policy_loss=None), "cem"),
        (dict(policy_loss=None), dict(policy_loss="cgp"), "actor"),
        (dict(policy_loss=None), dict(policy_loss="qgp"), "actor"),
        (dict(policy_loss=None), dict(policy_loss="cgp", policy_training="offline"), "cem"),
        (dict(inference="averaged_actor"), dict(policy_loss="qgp"), "averaged_actor"),
        (dict(inference="averaged_actor"), dict(inference=None), "actor"),
    ],
    ids=str,
)
def test_defaults_that_depend_on_other_arguments_are_resolved_when_loading(saved, loaded, inference, tmp_path):
    make_model(**saved).save(tmp_path / "model")
    model = CGP.load(tmp_path / "model", env=gym.make("Pendulum-v1"), **loaded)
    assert model.policy.inference == inference
    assert model.inference == loaded.get("inference", saved.get("inference"))
    # What it resolves to is saved as an argument no more than before
    model.save(tmp_path / "again")
    assert CGP.load(tmp_path / "again").inference == model.inference


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


def test_n_step_returns_obey_the_arguments_of_load(tmp_path):
    model = make_model(n_steps=3, gamma=0.99).learn(60)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    for n_steps, gamma in ((3, 0.5), (2, 0.99), (1, 0.9)):
        with warnings.catch_warnings():
            # No warning that `n_steps` is ignored
            warnings.simplefilter("error")
            loaded = CGP.load(tmp_path / "model", gym.make("Pendulum-v1"), n_steps=n_steps, gamma=gamma).learn(60)
        assert getattr(loaded.replay_buffer, "n_steps", 1) == n_steps
        assert getattr(loaded.replay_buffer, "gamma", gamma) == gamma
    # A buffer that was saved with other ones
    loaded = CGP.load(tmp_path / "model", gym.make("Pendulum-v1"), gamma=0.5)
    loaded.load_replay_buffer(tmp_path / "buffer")
    loaded.learn(10, reset_num_timesteps=False)
    assert set(loaded.replay_buffer.sample(64).discounts.flatten().tolist()) <= {0.5, 0.5**2, 0.5**3}
    # An attribute that changes between two trainings
    loaded.gamma = 0.25
    loaded.learn(10, reset_num_timesteps=False)
    assert loaded.replay_buffer.gamma == 0.25


@pytest.mark.parametrize(
    ("saved", "loaded", "message"),
    [
        (dict(), dict(n_steps=3), "`replay_buffer` is 'ReplayBuffer', but must be a NStepReplayBuffer"),
        (dict(n_steps=3), dict(n_steps=1), "`replay_buffer` is 'NStepReplayBuffer', but must be a ReplayBuffer"),
        (
            dict(replay_buffer_kwargs=dict(handle_timeout_termination=False)),
            dict(optimize_memory_usage=True),
            "`replay_buffer.optimize_memory_usage` is False, but must be True",
        ),
        (
            dict(),
            dict(replay_buffer_kwargs=dict(handle_timeout_termination=False)),
            "`replay_buffer.handle_timeout_termination` is True, but must be False",
        ),
    ],
    ids=str,
)
def test_a_loaded_buffer_that_contradicts_the_arguments_is_refused(saved, loaded, message, tmp_path):
    model = make_model(**saved).learn(60)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    other = CGP.load(tmp_path / "model", gym.make("Pendulum-v1"), **loaded)
    with pytest.raises(ValueError, match=message):
        other.load_replay_buffer(tmp_path / "buffer")
    # It learns with a buffer of its own
    assert other.replay_buffer is None
    other.learn(60)
    same = CGP.load(tmp_path / "model", gym.make("Pendulum-v1"))
    same.load_replay_buffer(tmp_path / "buffer")
    assert same.learn(10, reset_num_timesteps=False).replay_buffer.pos == 70


def test_what_sb3_chooses_is_not_stored_in_the_arguments(tmp_path):
    kwargs = {}
    model = make_model(n_steps=3, replay_buffer_kwargs=kwargs)
    assert (model.replay_buffer_class, model.replay_buffer_kwargs, kwargs) == (None, {}, {})
    model.save(tmp_path / "model")
    loaded = CGP.load(tmp_path / "model", gym.make("Pendulum-v1"), replay_buffer_class=ReplayBuffer, n_steps=1).learn(60)
    assert type(loaded.replay_buffer) is ReplayBuffer


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.usefixtures("short_policy_training")
def test_diagnostics_do_not_change_the_training(variant):
    arguments = dict(VARIANTS[variant], batch_size=4, action_noise=NormalActionNoise(np.zeros(1), np.ones(1)))
    models = [make_model(**arguments, diagnostics=diagnostics).learn(300) for diagnostics in (True, False)]
    assert ["train/cem_std" in model.logger.name_to_value for model in models] == [variant[4:] != "Offline", False]
    assert same_parameters(*models)
    assert all(model.replay_buffer.pos == 300 for model in models)
    assert np.array_equal(*(model.replay_buffer.actions for model in models))


def test_a_loaded_model_allocates_its_buffer_when_it_trains(tmp_path):
    model = make_model(buffer_size=700).learn(100)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = CGP.load(tmp_path / "model", env=gym.make("Pendulum-v1"))
    assert loaded.replay_buffer is None
    assert loaded.buffer_size == 700
    loaded.learn(100)
    assert loaded.replay_buffer.buffer_size == 700
    assert loaded.replay_buffer.size() == 100
    loaded.load_replay_buffer(tmp_path / "buffer")
    assert (loaded.replay_buffer.actions == model.replay_buffer.actions).all()


def test_a_loaded_model_goes_on_like_the_one_that_was_saved(tmp_path):
    model = make_model().learn(100)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = CGP.load(tmp_path / "model")
    loaded.load_replay_buffer(tmp_path / "buffer")
    for each in (model, loaded):
        each.set_random_seed(3)
        each.set_logger(model.logger)
        each.train(gradient_steps=30, batch_size=16)
    assert same_parameters(model, loaded)


def test_get_and_set_parameters():
    model, other = make_model(seed=0).learn(100), make_model(seed=1)
    assert set(model.get_parameters()) == {"policy", "actor.optimizer", "critic.optimizer"}
    other.set_parameters(model.get_parameters())
    assert same_parameters(model, other)


def test_the_saved_file_holds_no_network_twice(tmp_path):
    make_model().learn(100).save(tmp_path / "model.zip")
    data = json.loads(zipfile.ZipFile(tmp_path / "model.zip").read("data"))
    assert data.keys().isdisjoint({"policy", "actor", "actor_target", "critic", "critic_target", "replay_buffer"})
    assert not any("deferred" in key or "actor_lr_schedule" in key for key in data)


@pytest.mark.parametrize("policy_class", [CGPPolicy, CnnPolicy, MultiInputPolicy])
def test_a_policy_saved_alone_keeps_every_argument(policy_class, tmp_path):
    box = spaces.Box(0, 255, (3, 36, 36), np.uint8)
    space = {CGPPolicy: spaces.Box(-1, 1, (3,)), CnnPolicy: box, MultiInputPolicy: spaces.Dict(image=box)}[policy_class]
    policy = policy_class(space, spaces.Box(-2, 2, (2,)), lambda _: 1e-3, net_arch=[8], activation_fn=th.nn.Tanh, n_critics=3,
                          selector=CEM(3, 10, 2), inference="cem", cem_dtype="float32",
                          optimizer_kwargs=dict(weight_decay=0.1))  # fmt: skip
    classes = [each for each in policy_class.__mro__ if issubclass(each, TD3Policy)]
    named = {name for each in classes for name in inspect.signature(each.__init__).parameters} - {"self", "args", "kwargs"}
    assert {"net_arch", "selector", "cem_dtype", "n_critics"} <= named
    assert named <= set(policy._get_constructor_parameters())
    policy.save(tmp_path / "policy")
    loaded = policy_class.load(tmp_path / "policy")
    assert repr(loaded.selector) == "CEM(iterations=3, samples=10, elites=2, result='best')"
    assert loaded.inference == "cem"
    assert loaded.cem_dtype == "float32"
    observation = space.sample()
    th.manual_seed(0)
    action = policy.predict(observation)[0]
    th.manual_seed(0)
    assert np.array_equal(loaded.predict(observation)[0], action)


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


UNBOUNDED = spaces.Box(-np.inf, np.inf, (1,), np.float32)
EMPTY = spaces.Box(np.ones(1, np.float32), np.ones(1, np.float32))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (dict(cem_elites=9), "`cem_elites` is 9, but must be at most `cem_samples`, which is 8"),
        (dict(cem_iterations=0), "`cem_iterations` is 0, but must be an integer >= 1"),
        (dict(cem_samples=-1), "`cem_samples` is -1, but must be an integer >= 1"),
        (dict(cem_samples=8.0), "`cem_samples` is 8.0, but must be an integer >= 1"),
        (dict(cem_elites=True), "`cem_elites` is True, but must be an integer >= 1"),
        (dict(cem_result="median"), "`cem_result` is 'median', but must be one of 'best', 'mean'"),
        (dict(cem_dtype="float16"), "`cem_dtype` is 'float16', but must be one of 'auto', 'float32', 'bfloat16'"),
        (dict(cuda_graphs="yes"), "`cuda_graphs` is 'yes', but must be True or False"),
        (dict(policy_kwargs=dict(cem_dtype="float32")), "'cem_dtype'.*outside `policy_kwargs`"),
        (dict(batch_size=0), "`batch_size` is 0, but must be an integer >= 1"),
        (dict(buffer_size=0), "`buffer_size` is 0, but must be an integer >= 1"),
        (dict(n_steps=0), "`n_steps` is 0, but must be an integer >= 1"),
        (dict(learning_starts=-1), "`learning_starts` is -1, but must be an integer >= 0"),
        (dict(gradient_steps=-2), "`gradient_steps` is -2, but must be an integer >= -1"),
        (dict(train_freq=[1, "step"]), "`train_freq` is .*, but must be an int, or a tuple of an int and a unit"),
        (dict(policy_kwargs=dict(inference="cem")), "'inference'.*outside `policy_kwargs`"),
        (dict(train_freq=0), "`train_freq` is 0, but must be an integer >= 1"),
        (dict(train_freq=(1, "day")), "`train_freq` is .*, but must be in unit 'step' or 'episode'"),
        (dict(policy_delay=0), "`policy_delay` is 0, but must be an integer >= 1"),
        (dict(target_update_interval=-1), "`target_update_interval` is -1, but must be an integer >= 1"),
        (dict(tau=1.5), r"`tau` is 1.5, but must be a number within \[0, 1\]"),
        (dict(gamma=-0.1), r"`gamma` is -0.1, but must be a number within \[0, 1\]"),
        (dict(target_policy_noise=-0.2), "`target_policy_noise` is -0.2, but must be a finite number >= 0"),
        (dict(target_noise_clip=np.nan), "`target_noise_clip` is nan, but must be a finite number >= 0"),
        (dict(action_noise=NormalActionNoise(np.zeros(1), -np.ones(1))), "`action_noise` is .* standard deviation >= 0"),
        (dict(learning_rate=-1e-3), "`learning_rate` is -0.001, but must be a finite number >= 0"),
        (dict(actor_learning_rate="fast"), "`actor_learning_rate` is 'fast', but must be a number >= 0, a schedule, or"),
        (dict(actor_learning_rate="lin_-1"), "`actor_learning_rate` is 'lin_-1'"),
        (dict(policy_loss="sac"), "`policy_loss` is 'sac', but must be one of 'cgp', 'qgp', None"),
        (dict(policy_training="never"), "`policy_training` is 'never', but must be one of 'online', 'offline'"),
        (dict(inference="oracle"), "`inference` is 'oracle', but must be one of 'actor', 'averaged_actor', 'cem'"),
        (dict(policy_loss=None, policy_training="offline"), "`policy_training` is 'offline', but must be 'online'"),
        (dict(policy_loss=None, inference="actor"), "`inference` is 'actor', but must be 'cem'"),
        (dict(policy_loss=None, inference="averaged_actor"), "`inference` is 'averaged_actor', but must be 'cem'"),
        (
            dict(policy_training="offline", policy_kwargs=dict(share_features_extractor=True)),
            "`share_features_extractor` is True, but must be False",
        ),
    ],
    ids=str,
)
def test_bad_arguments_are_refused_at_construction_by_name_value_and_what_is_allowed(arguments, message):
    with pytest.raises(ValueError, match=message):
        make_model(**arguments)


@pytest.mark.parametrize(
    "action_space", [spaces.Discrete(3), spaces.MultiBinary(2), UNBOUNDED, EMPTY, spaces.Box(-1, 1, (0,))], ids=str
)
def test_action_spaces_that_cem_cannot_search_are_refused(action_space):
    class Unsearchable(gym.Env):
        observation_space = spaces.Box(-1, 1, (2,))

    Unsearchable.action_space = action_space
    with pytest.raises(ValueError, match=r"`action_space` is .*, but must be"):
        make_model(Unsearchable())


def test_noise_of_several_environments_is_checked_too():
    noise = VectorizedActionNoise(NormalActionNoise(np.zeros(1), -np.ones(1)), 2)
    with pytest.raises(ValueError, match="`action_noise`"):
        make_model(action_noise=noise)


@pytest.mark.parametrize("argument", ["inference", "cem_dtype"])
def test_a_policy_refuses_an_unknown_choice(argument):
    box = spaces.Box(-1, 1, (1,))
    with pytest.raises(ValueError, match=f"`{argument}` is 'dream'"):
        CGPPolicy(box, box, lambda _: 1e-3, **{argument: "dream"})


def test_the_data_type_of_cem_reaches_the_scores_and_can_be_changed_when_loading(tmp_path):
    model = make_model(cem_dtype="bfloat16", policy_kwargs=dict(net_arch=[32, 32]))
    model.save(tmp_path / "model")
    observations = th.randn(64, *model.observation_space.shape)

    def selected(model):
        th.manual_seed(0)
        return model.policy.select_actions(observations, model.critic).actions

    exact = CGP.load(tmp_path / "model", cem_dtype="float32")
    assert (CGP.load(tmp_path / "model").cem_dtype, exact.cem_dtype) == ("bfloat16", "float32")
    assert th.equal(selected(CGP.load(tmp_path / "model")), selected(model))
    assert not th.equal(selected(exact), selected(model))


@pytest.mark.parametrize(("given", "fused"), [(None, True), (dict(weight_decay=0.1), True), (dict(fused=False), False)])
def test_adam_is_fused_unless_the_user_says_otherwise(given, fused):
    model = make_model(policy_kwargs=dict(net_arch=[8], optimizer_kwargs=given))
    for network in (model.actor, model.critic):
        assert network.optimizer.defaults["fused"] is fused
    sgd = make_model(policy_kwargs=dict(net_arch=[8], optimizer_class=th.optim.SGD))
    assert sgd.actor.optimizer.defaults.get("fused") is None


def test_no_selector_is_cem_as_it_was_asked_for():
    assert make_model(cem_iterations=4, policy_kwargs=dict(selector=None)).policy.selector.iterations == 4


def test_refuses_a_policy_that_has_no_selector():
    with pytest.raises(ValueError, match=r"`policy` is .*TD3Policy.*, but must be a subclass of sb3_cgp.CGPPolicy"):
        make_model(policy=TD3.policy_aliases["MlpPolicy"])
