"""Losses of gradient steps that are CUDA graphs: when they are logged, and when one that is NaN is raised."""

import numpy as np
import pytest
import torch as th
from graph_models import make_model
from stable_baselines3.common.callbacks import BaseCallback

from sb3_cgp.fast.recorded_optimizers import LossWatch


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
    class Spoil(BaseCallback):
        def _on_training_start(self):
            # After the buffer has been checked
            self.model.replay_buffer.rewards[:] = np.inf

        def _on_step(self):
            return True

    model = make_model().learn(60)
    with pytest.raises(ValueError, match="critic loss was NaN or infinite at gradient step 31"):
        model.learn(5, callback=Spoil(), reset_num_timesteps=False)


def test_a_training_state_has_the_losses_of_recorded_steps_in_its_log(stand_in):
    model = make_model().learn(60)
    model.logger.name_to_value.clear()
    model.train(1, 16)
    (loss,) = model._unlogged["critic_loss"]
    model._before_saving_state()
    assert model.logger.name_to_value["train/critic_loss"] == pytest.approx(loss.item())
    # A NaN is reported before a state is saved that would hide it
    model.replay_buffer.rewards[:] = np.nan
    model.train(1, 16)
    with pytest.raises(ValueError, match="The critic loss was NaN or infinite at gradient step 32"):
        model._before_saving_state()


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


def test_the_offline_training_takes_its_steps_after_a_recorded_one_was_skipped(stand_in):
    model = make_model().learn(60)
    observations = model.replay_buffer.observations.copy()
    model.replay_buffer.observations[:] = np.nan
    model.train(1, 16)
    with pytest.raises(ValueError, match="loss was NaN or infinite at gradient step 31"):
        model.dump_logs()
    model.replay_buffer.observations[:] = observations
    before = [parameter.clone() for parameter in model.actor.parameters()]
    with pytest.warns(UserWarning, match="has not reached a plateau"):
        model.train_policy(max_steps=1)
    assert not any(map(th.equal, before, model.actor.parameters()))


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
