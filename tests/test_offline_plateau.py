"""The offline training of the policy: the rule by which it has converged, and what its steps do beside the actor's descent."""

import pytest
import torch as th
from small_models import make_model
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_cgp import CGP
from sb3_cgp.core.offline import has_plateaued


@pytest.mark.parametrize("first", [10.0, -10.0])
def test_a_plateau_is_five_rounds_in_a_row_whose_loss_is_not_5_percent_below_the_lowest(first):
    """Of either sign: QGP's loss is the negative of a value."""
    near, below = first - 0.4, first - 0.6
    assert not has_plateaued([first])
    assert not has_plateaued([first, *[near] * 4])
    assert has_plateaued([first, *[near] * 5])
    # One that falls begins the count anew, and is compared with from then on
    assert not has_plateaued([first, *[near] * 4, below, *[near] * 4])
    assert has_plateaued([first, *[near] * 4, below, *[near] * 5])
    # Not with the round before: these fall from each to the next, and never below the lowest
    assert has_plateaued([first, *(first + rise for rise in (5, 4, 3, 2, 1))])
    # Not with a round that has not counted: small falls add up
    assert not has_plateaued([first, near, below, near, near, near, near])


class Steps(BaseCallback):
    """Keeps what a function returns at each step."""

    def __init__(self, function):
        super().__init__()
        self.function, self.seen = function, []

    def _on_step(self):
        self.seen.append(self.function(self.model))
        return True


@pytest.fixture
def trained_critics():
    """Make a model whose critics have learnt, and whose actor has not."""

    def make(**kwargs):
        return OffPolicyAlgorithm.learn(make_model(policy_training="offline", **kwargs), 60)

    return make


@pytest.mark.filterwarnings("ignore:The policy's loss has not reached a plateau")
class TestSteps:
    """Of ``train_policy``."""

    @pytest.mark.parametrize("interval", [1, 3])
    def test_the_averaged_actor_follows_the_actor(self, trained_critics, interval):
        """With ``inference="averaged_actor"`` it is what acts."""
        model = trained_critics(tau=1.0, target_update_interval=interval)
        averages = Steps(lambda model: all(map(th.equal, model.actor.parameters(), model.actor_target.parameters())))
        model.train_policy(6, callback=averages)
        assert averages.seen == [step % interval == 0 for step in range(1, 7)]

    def test_the_actors_schedule_begins_anew_and_ends_with_the_steps(self, trained_critics):
        model = trained_critics(actor_learning_rate="lin_4e-3")
        rates = Steps(lambda model: model.actor.optimizer.param_groups[0]["lr"])
        model.train_policy(4, callback=rates)
        assert rates.seen == pytest.approx([4e-3, 3e-3, 2e-3, 1e-3])

    @pytest.mark.usefixtures("short_policy_training")
    @pytest.mark.parametrize("diagnostics", [True, False])
    def test_each_round_logs_how_the_actor_compares_with_cem(self, trained_critics, monkeypatch, diagnostics):
        model = trained_critics(diagnostics=diagnostics)
        log, rows = model.logger.name_to_value, []
        monkeypatch.setattr(model.logger, "dump", lambda step: (rows.append(set(log)), log.clear()))
        log.clear()
        model.train_policy(20)
        measured = {f"train/{name}" for name in ("cem_std", "saturated_actions", "actor_cem_distance", "cem_q_advantage")}
        assert rows == [{"train/actor_loss", "train/actor_learning_rate"} | (measured if diagnostics else set())] * 2

    @pytest.mark.parametrize(("given", "used"), [(5, 5), (None, 16)])
    def test_the_batch_size_is_the_given_one_or_the_models(self, trained_critics, monkeypatch, given, used):
        model = trained_critics()
        sizes, sample = [], model.replay_buffer.sample
        monkeypatch.setattr(model.replay_buffer, "sample", lambda size, env: sizes.append(size) or sample(size, env))
        model.train_policy(2, batch_size=given)
        assert sizes == [used, used]

    def test_fewer_steps_than_a_round_make_an_actor_if_no_more_were_asked_for(self, trained_critics):
        model = trained_critics()
        assert model.policy.inference == "cem"
        assert model.train_policy(3).policy.inference == "actor"


@pytest.mark.usefixtures("short_policy_training")
def test_cem_acts_in_a_copy_of_a_model_whose_critics_have_left_its_actor_behind(tmp_path):
    model = make_model(policy_training="offline").learn(100)
    OffPolicyAlgorithm.learn(model, 20, reset_num_timesteps=False)
    assert model.policy.inference == "cem"
    model.save(tmp_path / "model")
    loaded = CGP.load(tmp_path / "model")
    assert loaded.policy.inference == "cem"
    # Its own parameters change nothing
    loaded.set_parameters(loaded.get_parameters())
    assert loaded.policy.inference == "cem"
