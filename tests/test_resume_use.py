"""Using resumption: what goes on, what is kept, and what is refused."""

import shutil
import signal
import warnings

import gymnasium as gym
import numpy as np
import pytest
from environments import Doubles, Reach
from stable_baselines3 import TD3, HerReplayBuffer
from stable_baselines3.common.callbacks import CallbackList, CheckpointCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv
from trainings import SMALL, Interruption, Stop, Training, interrupted, parameters_equal

from sb3_cgp import CGP
from sb3_cgp.resumption import TrainingCheckpointCallback
from sb3_cgp.resumption.algorithm import resumable

pytestmark = pytest.mark.usefixtures("short_episodes")

GAUSSIAN = NormalActionNoise(np.zeros(1), 0.1 * np.ones(1))


def test_without_callbacks_states_go_on_being_saved(tmp_path):
    interrupted(tmp_path)
    model = CGP.resume(tmp_path / "state", make_vec_env("Pendulum-v1"))
    assert model.num_timesteps == 40
    model.learn(75)
    assert model.num_timesteps == 75
    resumed = CGP.resume(tmp_path / "state", make_vec_env("Pendulum-v1"))
    assert resumed.num_timesteps == 75
    assert parameters_equal(resumed, model)
    # A finished training has nothing to do, and can be made longer
    assert parameters_equal(resumed.learn(75), model)
    longer = CGP.resume(tmp_path / "state", make_vec_env("Pendulum-v1")).learn(90)
    assert (longer.num_timesteps, longer._n_updates) == (90, 70)


def test_second_trainings_go_on_to_their_own_end(tmp_path):
    def train(folder, stop):
        model = CGP("MlpPolicy", make_vec_env("Pendulum-v1", seed=1), policy_kwargs=dict(net_arch=[8]), **SMALL)
        checkpoint = TrainingCheckpointCallback(10, folder)
        model.learn(50, callback=checkpoint)
        with pytest.raises(Interruption) if stop else warnings.catch_warnings():
            model.learn(60, callback=[checkpoint, Stop(stop)], reset_num_timesteps=False)
        return model

    expected = train(tmp_path / "straight", None)
    train(tmp_path / "state", 73)
    model = CGP.resume(tmp_path / "state", make_vec_env("Pendulum-v1")).learn(60, reset_num_timesteps=False)
    assert model.num_timesteps == expected.num_timesteps == 110
    assert parameters_equal(model, expected)


def test_the_states_of_another_training_are_not_overwritten(tmp_path):
    interrupted(tmp_path)
    before = sorted((tmp_path / "state").rglob("*"))
    with pytest.raises(ValueError, match=r"`path` is '.*state', but must be a folder without the states of another training"):
        Training(tmp_path).run()
    assert sorted((tmp_path / "state").rglob("*")) == before


def test_a_training_that_ended_in_the_middle_of_a_step_leaves_the_last_whole_one(tmp_path):
    training = Training(tmp_path, save_freq=10)
    stop = CheckpointCallback(1, str(tmp_path))
    stop._on_step = lambda: stop.num_timesteps < 47
    training.make_model().learn(90, callback=[TrainingCheckpointCallback(10, tmp_path / "state"), stop])
    assert CGP.resume(tmp_path / "state", training.make_env(1)).num_timesteps == 40


class GlobalDoubles(Doubles):
    """Draws from NumPy's global generator."""

    def observe(self):
        return np.random.normal(size=3)  # noqa: NPY002


class WithoutSeed(DummyVecEnv):
    """Has no method ``seed``, as those of some packages."""

    @property
    def seed(self):
        raise AttributeError("seed", name="seed", obj=self)


@pytest.mark.parametrize("seed", [None, 0])
@pytest.mark.parametrize(
    ("environment", "kind", "n_envs"),
    [(Doubles, DummyVecEnv, 1), (Doubles, DummyVecEnv, 3), (GlobalDoubles, DummyVecEnv, 1), (GlobalDoubles, WithoutSeed, 1)],
)
@pytest.mark.filterwarnings("ignore:The environment's state", "ignore:.*has no method `seed`")
def test_each_resumption_begins_new_episodes_that_follow_from_its_step(environment, kind, n_envs, seed, tmp_path):
    begun = []

    class Recording(kind):
        def reset(self):
            observations = super().reset()
            begun.append(observations.copy())
            return observations

    def make():
        made = Recording([environment] * n_envs)
        if kind is DummyVecEnv:
            made.seed(1)
        begun.clear()
        return made

    def resume(steps):
        made = make()
        CGP.resume(tmp_path / "state", made).learn(steps)
        return begun[0]

    model = CGP("MlpPolicy", make(), policy_kwargs=dict(net_arch=[4]), **(SMALL | dict(seed=seed)))
    model.learn(12, TrainingCheckpointCallback(3, tmp_path / "state"))
    del model
    shutil.copytree(tmp_path / "state", tmp_path / "copy")
    starts = [begun[0], resume(24), resume(36)]
    # No environment begins as another one, or as another time
    assert len(np.unique(np.concatenate(starts), axis=0)) == 3 * n_envs
    shutil.rmtree(tmp_path / "state")
    (tmp_path / "copy").rename(tmp_path / "state")
    np.testing.assert_array_equal(resume(24), starts[1])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (dict(save_freq=0), "`save_freq` is 0, but must be"),
        (dict(save_freq=2.5), "`save_freq` is 2.5, but must be"),
        (dict(save_freq=1, keep=0), "`keep` is 0, but must be"),
    ],
)
def test_bad_arguments_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        TrainingCheckpointCallback(**arguments)


def test_without_a_path_a_warning_says_that_nothing_is_saved(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    handler = signal.getsignal(signal.SIGTERM)
    model = CGP("MlpPolicy", "Pendulum-v1", policy_kwargs=dict(net_arch=[8]), **SMALL)
    with pytest.warns(UserWarning, match="No state of the training will be saved, as `path` is None"):
        model.learn(40, callback=TrainingCheckpointCallback(10))
    assert list(tmp_path.iterdir()) == []
    assert signal.getsignal(signal.SIGTERM) is handler


def test_an_environment_that_did_not_fit_can_be_replaced(tmp_path):
    training = interrupted(tmp_path)
    expected = training.learn(CGP.resume(tmp_path / "state", training.make_env(7)), None)
    interrupted(tmp_path / "again")
    model = CGP.resume(tmp_path / "again" / "state", DummyVecEnv([lambda: gym.make("Pendulum-v1")]))
    with pytest.raises(ValueError, match=r"`env` is .*, but must be what the state was saved from"):
        model.learn(120)
    model.set_env(training.make_env(8))
    model.learn(120)
    assert (model.num_timesteps, model._n_updates) == (120, 100)
    assert parameters_equal(model, expected)


def test_the_environment_may_be_given_by_its_name(tmp_path):
    model = CGP("MlpPolicy", "Pendulum-v1", policy_kwargs=dict(net_arch=[8]), **SMALL)
    model.learn(30, callback=TrainingCheckpointCallback(10, tmp_path / "state"))
    assert CGP.resume(tmp_path / "state", "Pendulum-v1").learn(40).num_timesteps == 40


def test_what_does_not_fit_is_refused(tmp_path):
    training = interrupted(tmp_path)
    with pytest.raises(ValueError, match=r"`env.num_envs` is 3, but must be 1, as was saved"):
        CGP.resume(tmp_path / "state", make_vec_env("Pendulum-v1", n_envs=3))
    with pytest.raises(ValueError, match=r"`buffer_size` is 20, but must be at least 40"):
        CGP.resume(tmp_path / "state", training.make_env(1), buffer_size=20)
    with pytest.raises(ValueError, match=r"`n_envs` is 3, but must be left out, or 1"):
        CGP.resume(tmp_path / "state", training.make_env(1), n_envs=3)
    with pytest.raises(FileNotFoundError, match="nowhere"):
        CGP.resume(tmp_path / "nowhere", training.make_env(1))


def test_a_wrong_number_of_environments_is_named_by_an_algorithm_without_guards(tmp_path):
    algorithm = resumable(TD3)
    model = algorithm("MlpPolicy", "Pendulum-v1", buffer_size=50, policy_kwargs=dict(net_arch=[4]))
    model.learn(10, TrainingCheckpointCallback(10, tmp_path))
    with pytest.raises(ValueError, match=r"`n_envs` is 2, but must be 1, as was saved"):
        algorithm.resume(tmp_path, "Pendulum-v1", n_envs=2)


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("saved", [None, GAUSSIAN], ids=["none saved", "another saved"])
def test_action_noise_may_be_given_to_resume(saved, n_envs, tmp_path):
    interrupted(tmp_path, action_noise=saved, n_envs=n_envs)
    noise = OrnsteinUhlenbeckActionNoise(np.zeros(1), np.full(1, 0.5))
    model = CGP.resume(tmp_path / "state", make_vec_env("Pendulum-v1", n_envs), action_noise=noise)
    # Beyond the end of an episode, at which SB3 resets the noise of that environment
    model.learn(140)
    assert model.num_timesteps == 140
    noises = model.action_noise.noises if n_envs > 1 else [model.action_noise]
    assert len(noises) == n_envs
    # Each environment has its own
    assert len({float(each.noise_prev[0]) for each in noises}) == n_envs


@pytest.mark.parametrize("value", [True, False])
@pytest.mark.parametrize("algorithm", [CGP, resumable(TD3)], ids=["CGP", "TD3"])
def test_a_reset_of_the_environment_is_no_argument_of_resume(algorithm, value, tmp_path):
    arguments = dict(policy_kwargs=dict(net_arch=[8]), learning_starts=5, buffer_size=20, batch_size=4, device="cpu")
    algorithm("MlpPolicy", "Pendulum-v1", **arguments).learn(8, callback=TrainingCheckpointCallback(8, tmp_path))
    message = (
        rf"`force_reset` is {value}, but `{algorithm.__name__}.resume` takes no such argument\. Leave it out: .* restores"
    )
    with pytest.raises(TypeError, match=message):
        algorithm.resume(tmp_path, "Pendulum-v1", force_reset=value)
    # The other arguments of `load`; the folder is not locked
    model = algorithm.resume(tmp_path, "Pendulum-v1", custom_objects={}, print_system_info=False, batch_size=3)
    assert model.batch_size == 3


def test_hindsight_with_the_environments_information_is_refused_before_it_trains(tmp_path):
    arguments = SMALL | dict(replay_buffer_class=HerReplayBuffer, replay_buffer_kwargs=dict(copy_info_dict=True))
    model = CGP("MultiInputPolicy", make_vec_env(Reach), **arguments)
    with pytest.raises(ValueError, match="`copy_info_dict` is True, but must be False where the training is saved"):
        model.learn(40, callback=TrainingCheckpointCallback(10, tmp_path))
    assert model.num_timesteps == 0


def test_callbacks_that_are_gone_are_named(tmp_path):
    class Counting(Stop):
        counted = 0

        def _on_step(self):
            self.counted += 1
            return super()._on_step()

    training = Training(tmp_path)
    model = CGP("MlpPolicy", training.make_env(1), policy_kwargs=dict(net_arch=[8]), **SMALL)
    callbacks = CallbackList([TrainingCheckpointCallback(10, tmp_path / "state"), Counting(47)])
    with pytest.raises(Interruption):
        model.learn(60, callback=callbacks)
    model = CGP.resume(tmp_path / "state", training.make_env(1))
    with pytest.warns(UserWarning, match="Counting was among the callbacks, and is not now: what it counted is lost"):
        model.learn(60)


def test_callbacks_keep_their_new_arguments_and_their_old_counters(tmp_path):
    training = interrupted(tmp_path)
    evaluation = EvalCallback(training.make_env(3), eval_freq=1_000, n_eval_episodes=1, verbose=0)
    model = CGP.resume(tmp_path / "state", training.make_env(1))
    model.learn(60, callback=[TrainingCheckpointCallback(10, tmp_path / "state"), evaluation])
    assert (evaluation.eval_freq, evaluation.n_eval_episodes, evaluation.n_calls) == (1_000, 1, 60)
    assert evaluation.best_mean_reward == max(map(np.mean, training.evaluation.evaluations_results))


def events_of(folder):
    return sorted(path.name for path in folder.iterdir() if any(path.glob("events.*")))


def tiny(**kwargs):
    return CGP("MlpPolicy", "Pendulum-v1", policy_kwargs=dict(net_arch=[8]), **(SMALL | kwargs))


def test_tensorboard_goes_on_in_the_trainings_folder_or_in_a_new_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tiny(tensorboard_log="log").learn(30, TrainingCheckpointCallback(10, "state"))
    # Of another training
    tiny(tensorboard_log="log").learn(30)
    assert events_of(tmp_path / "log") == ["CGP_1", "CGP_2"]
    of_another = sorted((tmp_path / "log" / "CGP_2").iterdir())

    def resume(**kwargs):
        return CGP.resume("state", "Pendulum-v1", **kwargs)

    resume().learn(40)
    assert len(list((tmp_path / "log" / "CGP_1").iterdir())) == 2
    # Another folder
    resume(tensorboard_log="other").learn(50)
    assert events_of(tmp_path / "other") == ["CGP_1"]
    # The folder is gone, as on another machine
    shutil.rmtree(tmp_path / "log" / "CGP_1")
    shutil.rmtree(tmp_path / "other" / "CGP_1")
    resume(tensorboard_log="log").learn(60)
    assert events_of(tmp_path / "log") == ["CGP_2", "CGP_3"]
    assert sorted((tmp_path / "log" / "CGP_2").iterdir()) == of_another


def test_tensorboard_that_is_given_to_resume_alone_is_written_there(tmp_path):
    tiny().learn(30, TrainingCheckpointCallback(10, tmp_path / "state"))
    CGP.resume(tmp_path / "state", "Pendulum-v1", tensorboard_log=str(tmp_path / "log")).learn(40)
    assert events_of(tmp_path / "log") == ["CGP_1"]
