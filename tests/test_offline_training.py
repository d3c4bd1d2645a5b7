"""The offline training of the policy: when it happens, what it changes, and what stops it."""

import math
import warnings

import gymnasium as gym
import pytest
import torch as th
from small_models import make_model
from stable_baselines3.common.callbacks import (
    BaseCallback,
    EvalCallback,
    EventCallback,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnNoModelImprovement,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

from sb3_cgp import CGP


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

    @pytest.mark.parametrize("policy_loss", [None, "cgp"])
    @pytest.mark.parametrize("steps", [10, 60], ids=["random steps", "gradient steps"])
    def test_one_that_is_due_is_left_out_where_the_training_goes_on_otherwise(self, steps, policy_loss):
        model = make_model(policy_training="offline").learn(100, callback=self.Watcher(107))
        model.policy_training = "online"
        model.policy_loss = policy_loss
        watcher = self.Watcher()
        model.learn(steps, callback=watcher)
        assert watcher.n_calls == steps
        assert model.policy.inference == ("actor" if steps == 60 and policy_loss == "cgp" else "cem")

    def test_an_actor_is_out_of_date_when_the_critics_have_learnt_without_it(self):
        model = make_model(policy_training="offline").learn(100)
        assert model.policy.inference == "actor"
        model.policy_training = "online"
        model.policy_loss = None
        model.learn(60)
        model.policy_loss = "cgp"
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

    def test_a_loaded_model_logs_in_a_folder_of_its_own(self, tmp_path):
        logs = str(tmp_path / "logs")
        model = make_model(tensorboard_log=logs).learn(60)
        model.save(tmp_path / "model")
        model.save_replay_buffer(tmp_path / "buffer")
        # The newest folder is another's
        make_model(tensorboard_log=logs).learn(60)
        loaded = CGP.load(tmp_path / "model", env="Pendulum-v1")
        loaded.load_replay_buffer(tmp_path / "buffer")
        loaded.train_policy(max_steps=60)
        assert loaded.logger.dir == f"{logs}/CGP_3"

    # A round has ten steps here, and the plateau is after six rounds at the earliest
    @pytest.mark.parametrize(("n_steps", "acts"), [(7, "CEM"), (17, "the actor")])
    def test_a_policy_that_a_callback_stops_before_its_plateau_is_warned_of_and_stays_due(self, n_steps, acts):
        model = make_model(policy_training="offline")
        message = f"A callback stopped the policy's training after {n_steps} steps: {acts} acts"
        with pytest.warns(UserWarning, match=message):
            model.learn(100, callback=self.Watcher(stop_after=100 + n_steps))
        assert model.policy.inference == {"CEM": "cem", "the actor": "actor"}[acts]
        # Further steps of the environment are not needed
        watcher = self.Watcher()
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            model.learn(0, callback=watcher, reset_num_timesteps=False)
        assert len(watcher.actors) >= 60
        assert model.learn(0, callback=self.Watcher(), reset_num_timesteps=False).policy.inference == "actor"

    def test_a_callback_that_has_stopped_the_critics_training_stops_the_policys(self, tmp_path):
        """SB3's, which goes on to find no improvement: the policy has a round and no more."""
        stop = StopTrainingOnNoModelImprovement(max_no_improvement_evals=1)
        evaluation = EvalCallback(make_vec_env("Pendulum-v1"), callback_after_eval=stop, eval_freq=15, n_eval_episodes=1)
        stop.last_best_mean_reward = evaluation.best_mean_reward = math.inf
        model = make_model(policy_training="offline", learning_starts=10)
        with pytest.warns(UserWarning, match="A callback stopped the policy's training after 15 steps: the actor acts"):
            model.learn(100, callback=evaluation)
        assert model.num_timesteps < 100

    def test_cem_acts_while_the_critics_learn_again(self):
        model = make_model(policy_training="offline", cem_start="actor").learn(100)
        watcher = self.Watcher()
        model.learn(20, callback=watcher, reset_num_timesteps=False)
        # The callback sees a step before its gradient step
        assert watcher.inferences[:20] == ["actor"] + ["cem"] * 19
        assert set(watcher.inferences[20:]) == {"actor"}
        assert (model.policy.inference, model.policy.actor_proposes) == ("actor", True)

    def test_a_model_trained_online_acts_by_its_actor_when_it_is_loaded_to_train_offline(self, tmp_path):
        make_model().learn(100).save(tmp_path / "model")
        assert CGP.load(tmp_path / "model", policy_training="offline").policy.inference == "actor"
        assert CGP.load(tmp_path / "model", policy_loss=None).policy.inference == "cem"
        make_model().save(tmp_path / "untrained")
        assert CGP.load(tmp_path / "untrained", policy_training="offline").policy.inference == "cem"

    @pytest.mark.parametrize("saved", [dict(policy_loss=None), dict(policy_training="offline")], ids=["no actor", "offline"])
    @pytest.mark.parametrize("further", [dict(), dict(cem_start="actor"), dict(policy_delay=7)], ids=str)
    def test_an_actor_that_lags_behind_its_critics_acts_when_it_has_been_trained(self, saved, further, tmp_path):
        model = make_model(**saved)
        OffPolicyAlgorithm.learn(model, 100)
        model.save(tmp_path / "model")
        online = dict(policy_loss="cgp", policy_training="online")
        loaded = CGP.load(tmp_path / "model", env=gym.make("Pendulum-v1"), **online, **further)
        assert (loaded.policy.inference, loaded.policy.actor_proposes) == ("cem", False)
        with pytest.raises(ValueError, match="there is no trained actor"):
            loaded.export(tmp_path / "exported")
        watcher = self.Watcher()
        loaded.learn(70, callback=watcher)
        # The callback sees a step before its gradient step; 50 steps are random
        gradient_steps = next(n for n in range(1, 100) if (50 + n) % loaded.policy_delay == 0)
        assert watcher.inferences == ["cem"] * (50 + gradient_steps) + ["actor"] * (20 - gradient_steps)
        assert loaded.policy.actor_proposes

    @pytest.mark.parametrize("delay", [1, 30])
    def test_a_new_online_policy_acts_from_the_start(self, delay, tmp_path):
        watcher = self.Watcher()
        model = make_model(policy_delay=delay, cem_start="actor").learn(60, callback=watcher)
        assert set(watcher.inferences) == {"actor"}
        model.save(tmp_path / "model")
        loaded = CGP.load(tmp_path / "model")
        assert (loaded.policy.inference, loaded.policy.actor_proposes) == ("actor", True)

    def test_the_first_training_of_an_actor_leaves_the_users_choice_alone(self):
        model = make_model()
        with model.policy.acting_by("averaged_actor"):
            assert model.learn(60).policy.inference == "averaged_actor"

    def test_a_policy_that_a_callback_stops_too_early_does_not_act_in_a_loaded_model_either(self, tmp_path):
        model = make_model(policy_loss=None).learn(100)
        model.save(tmp_path / "model")
        model.save_replay_buffer(tmp_path / "buffer")
        loaded = CGP.load(tmp_path / "model", policy_loss="cgp")
        loaded.load_replay_buffer(tmp_path / "buffer")
        with pytest.warns(UserWarning, match="A callback stopped the policy's training after 3 steps: CEM acts"):
            loaded.train_policy(callback=self.Watcher(stop_after=3))
        assert loaded.policy.inference == "cem"
        assert loaded.train_policy().policy.inference == "actor"

    def test_trained_critics_with_an_untrained_actor_are_warned_of_where_their_parameters_are_set(self):
        parameters = make_model(policy_loss=None).learn(100).get_parameters()
        with pytest.warns(UserWarning, match="the actor is not: `predict` uses it nevertheless"):
            make_model().set_parameters(parameters)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            # CEM acts in these
            make_model(policy_training="offline").set_parameters(parameters)
            make_model(inference="cem").set_parameters(parameters)
            # Neither has been trained
            make_model().set_parameters(make_model(policy_loss=None).get_parameters())

    @pytest.mark.parametrize("way", ["file", "dictionary"])
    def test_a_trained_actor_acts_where_its_parameters_are_set(self, way, tmp_path):
        def given(model):
            model.save(tmp_path / "model.zip")
            return str(tmp_path / "model.zip") if way == "file" else model.get_parameters()

        new = make_model(policy_training="offline", seed=1)
        new.set_parameters(given(make_model(policy_training="offline")))
        assert new.policy.inference == "cem"
        trained = make_model(policy_training="offline").learn(100)
        new.set_parameters(given(trained))
        assert new.policy.inference == "actor"
        observation = new.observation_space.sample()
        assert new.predict(observation)[0] == trained.predict(observation)[0]

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


def test_a_callback_may_make_another_one_at_its_first_step():
    class Making(EventCallback):
        def _on_step(self):
            if self.callback is None:
                self.callback = Looking()
                self.callback.init_callback(self.model)
                return True
            self.locals["infos"][0]["seen"] = self.locals["infos"][0].get("seen", 0) + 1
            return self._on_event()

    class Looking(BaseCallback):
        def _on_step(self):
            seen.append(dict(self.locals["infos"][0]))
            return True

    seen = []
    model = make_model(policy_loss="cgp").learn(20)
    with pytest.warns(UserWarning, match="has not reached a plateau"):
        model.train_policy(3, callback=Making())
    # Each step has infos of its own
    assert seen == [{"seen": 1}] * 2
