"""Resumed trainings against straight ones: the same to the bit, wherever they were stopped."""

import os
import random
import signal
import subprocess
import sys
import time
import warnings

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from environments import Doubles, Reach
from gymnasium import spaces
from hypothesis import HealthCheck, Phase, example, given, settings
from hypothesis import strategies as st
from stable_baselines3 import TD3, HerReplayBuffer
from stable_baselines3.common.callbacks import CallbackList, CheckpointCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv
from trainings import SMALL, Interruption, Stop, Training, assert_same, fingerprint

from sb3_cgp import CGP
from sb3_cgp.resumption import TrainingCheckpointCallback
from sb3_cgp.resumption.algorithm import resumable
from sb3_cgp.resumption.store import StateStore

pytestmark = pytest.mark.usefixtures("short_episodes")


class Images(Doubles):
    """Images, and a state of which Gymnasium's generator is saved anyway."""

    observation_space = spaces.Box(0, 255, (1, 36, 36), np.uint8)

    def observe(self):
        return self.np_random.integers(0, 256, (1, 36, 36), np.uint8)

    def get_training_state(self):
        return {"steps": getattr(self, "steps", None)}

    def set_training_state(self, state):
        self.steps = state["steps"]


class Disturbed(gym.Wrapper):
    """Draws from its action space, which random actions are drawn from, too."""

    def step(self, action):
        return self.env.step(np.clip(action + 0.1 * self.action_space.sample(), -2, 2))

    def get_training_state(self):
        return ()

    def set_training_state(self, state):
        assert state == ()


class Opaque(gym.Wrapper):
    """A wrapper of somebody's own, which may do anything."""


UNHURRIED = settings(
    deadline=None,
    derandomize=True,
    phases=[Phase.explicit, Phase.generate],
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
GAUSSIAN = NormalActionNoise(np.zeros(1), 0.1 * np.ones(1))
NOISE = OrnsteinUhlenbeckActionNoise(np.zeros(1), 0.2 * np.ones(1))
CASES = {
    "CGP-Online": dict(),
    "QGP-Online": dict(policy_loss="qgp"),
    "CEM": dict(policy_loss=None),
    "CGP-Offline": dict(policy_training="offline"),
    "QGP-Offline": dict(policy_loss="qgp", policy_training="offline"),
    "CGP-Light": dict(cem_start="actor", cem_iterations=1),
    "from the actor, offline": dict(cem_start="actor", policy_training="offline"),
    "averaged actor, delays": dict(inference="averaged_actor", policy_delay=3, target_update_interval=4),
    "n-step": dict(n_steps=3),
    "VecNormalize": dict(normalises=True),
    "environments": dict(n_envs=3, train_freq=2, gradient_steps=-1),
    "environments, normalised, noise": dict(n_envs=2, normalises=True, action_noise=GAUSSIAN),
    "Ornstein-Uhlenbeck": dict(action_noise=NOISE),
    "schedules": dict(learning_rate="lin_1e-3", actor_learning_rate="lin_1e-2"),
    "episodes": dict(env="InvertedPendulum-v5", train_freq=(1, "episode"), gradient_steps=-1, save_freq=1),
    "MuJoCo": dict(env="Reacher-v5", normalises=True, n_steps=2),
    "lean": dict(optimize_memory_usage=True, replay_buffer_kwargs=dict(handle_timeout_termination=False)),
    "dictionaries": dict(env=Reach, policy="MultiInputPolicy"),
    "hindsight": dict(env=Reach, policy="MultiInputPolicy", replay_buffer_class=HerReplayBuffer, n_envs=2, save_freq=14),
    "hindsight, normalised": dict(
        env=Reach, policy="MultiInputPolicy", replay_buffer_class=HerReplayBuffer, normalises=True, save_freq=14
    ),
    "random steps": dict(learning_starts=90, n_envs=2),
    "disturbed random steps": dict(env=lambda: Disturbed(gym.make("Pendulum-v1")), learning_starts=90),
    "images": dict(
        env=Images, policy="CnnPolicy", policy_kwargs=dict(features_extractor_kwargs=dict(features_dim=4)), steps=60
    ),
    "optimizer": dict(policy_kwargs=dict(net_arch=[8], optimizer_class=th.optim.RMSprop, optimizer_kwargs=dict(momentum=0.9))),
}


@pytest.fixture(autouse=True)
def short_policy_training(monkeypatch):
    monkeypatch.setattr("sb3_cgp.core.offline.ROUND", 10)


def straight(folder, case, **arguments):
    """Train without an interruption, saving no state but the last."""
    training = Training(folder / "straight", **(CASES[case] | arguments | dict(save_freq=10_000)))
    return training, fingerprint(training, training.run())


def resumed_is_straight(folder, case, **arguments):
    training, expected = straight(folder, case, **arguments)
    resumed = Training(folder / "resumed", **CASES[case], **arguments)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # SB3's, whenever a model with an n-step buffer is loaded
        warnings.filterwarnings("ignore", message="`n_steps=")
        assert_same(fingerprint(resumed, resumed.run(47, 83, 118)), expected)
    for step, line in training.written.lines.items():
        assert resumed.written.lines[step] == pytest.approx(line, rel=0, abs=0, nan_ok=True)


@pytest.mark.parametrize("case", CASES)
def test_resumed_training_is_straight_training(tmp_path, case):
    resumed_is_straight(tmp_path, case)


@pytest.mark.usefixtures("gpu")
@pytest.mark.parametrize("case", ["CGP-Online", "CGP-Offline", "averaged actor, delays", "schedules", "VecNormalize"])
def test_resumed_training_on_a_gpu_is_straight_training(tmp_path, case):
    resumed_is_straight(tmp_path, case, device="cuda")


def any_stops(test):
    """Hand a test any training, stopped anywhere; a failing one is not made smaller, which would take minutes."""
    stops = st.lists(st.integers(42, 125), min_size=1, max_size=4)
    return given(case=st.sampled_from(list(CASES)), stops=stops, save_freq=st.integers(1, 10))(test)


def stopped_anywhere(folder, case, stops, save_freq):
    _, expected = straight(folder, case)
    resumed = Training(folder / "resumed", **(CASES[case] | dict(save_freq=save_freq)))
    assert_same(fingerprint(resumed, resumed.run(*stops)), expected)


@settings(UNHURRIED, max_examples=3)
@example(case="CGP-Online", stops=[113, 102, 100, 64], save_freq=2)
@example(case="QGP-Online", stops=[81], save_freq=9)
@any_stops
def test_wherever_it_was_stopped(tmp_path_factory, case, stops, save_freq):
    stopped_anywhere(tmp_path_factory.mktemp("training"), case, stops, save_freq)


@pytest.mark.slow
@settings(UNHURRIED, max_examples=40)
@any_stops
def test_wherever_it_was_stopped_more_often(tmp_path_factory, case, stops, save_freq):
    stopped_anywhere(tmp_path_factory.mktemp("training"), case, stops, save_freq)


@pytest.mark.slow
@pytest.mark.parametrize("case", [dict(), dict(env="Hopper-v5", n_steps=3, normalises=True)], ids=["Pendulum", "Hopper"])
def test_10_000_steps_straight_and_stopped(tmp_path, case):
    arguments = case | dict(steps=10_000, save_freq=500, eval_freq=2_000, buffer_size=6_000, learning_starts=1_000)
    straight, stopped = (Training(tmp_path / name, **arguments) for name in ("straight", "stopped"))
    stops = sorted(random.Random(0).sample(range(600, 10_000), 4))
    assert_same(fingerprint(stopped, stopped.run(*stops)), fingerprint(straight, straight.run()))


def interrupted(folder, stop=47, **case):
    """Train until the stop."""
    training = Training(folder, **case)
    with pytest.raises(Interruption):
        training.learn(training.make_model(), stop)
    return training


def parameters(model):
    return th.cat([parameter.detach().flatten() for parameter in model.policy.parameters()])


def test_without_callbacks_states_go_on_being_saved(tmp_path):
    interrupted(tmp_path)
    model = CGP.resume(tmp_path / "state", make_vec_env("Pendulum-v1"))
    assert model.num_timesteps == 40
    model.learn(75)
    assert model.num_timesteps == 75
    resumed = CGP.resume(tmp_path / "state", make_vec_env("Pendulum-v1"))
    assert resumed.num_timesteps == 75
    assert th.equal(parameters(resumed), parameters(model))
    # A finished training has nothing to do, and can be made longer
    assert th.equal(parameters(resumed.learn(75)), parameters(model))
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
    assert th.equal(parameters(model), parameters(expected))


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


def test_an_environment_that_cannot_be_restored_begins_an_episode(tmp_path):
    case = dict(env=lambda: Opaque(Reach()), policy="MultiInputPolicy", normalises=False)
    training = interrupted(tmp_path, **case)
    model = CGP.resume(tmp_path / "state", training.make_env(5))
    assert model.num_timesteps == 40
    with pytest.warns(
        UserWarning, match=r"The environment's state was not saved: .* The training continues at the start of a new episode"
    ):
        training.learn(model, None)
    assert (model.num_timesteps, model._n_updates) == (120, 100)


@pytest.mark.parametrize("case", ["n-step", "lean", "hindsight"])
def test_no_return_crosses_the_gap_where_an_environment_was_not_restored(tmp_path, case):
    training = Training(tmp_path, **CASES[case])
    training.env = lambda: Opaque(Reach() if case == "hindsight" else gym.make("Pendulum-v1"))
    model = training.make_model()
    with pytest.raises(Interruption):
        training.learn(model, 47)
    model = CGP.resume(tmp_path / "state", training.make_env(5))
    last = model.replay_buffer.pos - 1
    assert not model.replay_buffer.dones[last].any()
    with pytest.warns(UserWarning, match="The environment's state was not saved"):
        training.learn(model, None)
    assert model.replay_buffer.dones[last].all()


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
    assert th.equal(parameters(model), parameters(expected))


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
    with pytest.raises(FileNotFoundError, match="nowhere"):
        CGP.resume(tmp_path / "nowhere", training.make_env(1))


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


SCRIPT = """
import sys, gymnasium, numpy as np
from sb3_cgp import CGP
from trainings import Training, fingerprint
gymnasium.spec("Pendulum-v1").max_episode_steps = 25
training = Training(sys.argv[1], normalises=True, steps=int(sys.argv[2]), save_freq=25, eval_freq=200)
state = training.folder / "state"
if list(state.glob("state-*.json")):
    model = CGP.resume(state, training.make_env(7))
else:
    model = training.make_model()
training.learn(model, None)
np.savez(training.folder / "result", **fingerprint(training, model))
"""


def process(folder, steps):
    environment = os.environ | {"PYTHONPATH": os.path.dirname(__file__), "OMP_NUM_THREADS": "1"}
    return subprocess.Popen([sys.executable, "-c", SCRIPT, str(folder), str(steps)], stdout=subprocess.PIPE, env=environment)


def wait_for_state(folder, beyond):
    while max(StateStore(folder / "state").steps(), default=0) <= beyond:
        time.sleep(0.01)


def test_stopped_processes_go_on_in_new_ones(tmp_path):
    steps, reached = 400, 0
    for number, status in ((signal.SIGTERM, 143), (signal.SIGKILL, -9)):
        stopped = process(tmp_path / "stopped", steps)
        wait_for_state(tmp_path / "stopped", reached)
        stopped.send_signal(number)
        assert stopped.wait() == status
        assert not (tmp_path / "stopped" / "result.npz").exists()
        reached = max(StateStore(tmp_path / "stopped" / "state").steps())
        assert 0 < reached < steps
    assert process(tmp_path / "stopped", steps).wait() == 0
    straight = Training(tmp_path / "straight", normalises=True, steps=steps, save_freq=25, eval_freq=200)
    expected = fingerprint(straight, straight.run())
    with np.load(tmp_path / "stopped" / "result.npz") as found:
        assert_same(dict(found), expected)
