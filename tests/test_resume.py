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
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from trainings import Interruption, Training, assert_same, fingerprint, interrupted

from sb3_cgp import CGP
from sb3_cgp.resumption.store import StateStore
from sb3_cgp.selectors import MPPI, ActorOnly, ActorStart

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
# The defaults, by which no warning says that another selector replaces CEM
UNUSED = dict(cem_samples=64, cem_elites=6)
CASES = {
    "CGP-Online": dict(),
    "QGP-Online": dict(policy_loss="qgp"),
    "CEM": dict(policy_loss=None),
    "CGP-Offline": dict(policy_training="offline"),
    "QGP-Offline": dict(policy_loss="qgp", policy_training="offline"),
    "CGP-Light": dict(cem_start="actor", cem_iterations=1),
    "from the actor, offline": dict(cem_start="actor", policy_training="offline"),
    "MPPI": dict(policy_kwargs=dict(net_arch=[8], selector=MPPI(2, 8, 3, start=ActorStart())), **UNUSED),
    "the actor alone": dict(
        policy_kwargs=dict(net_arch=[8], selector=ActorOnly()), policy_loss="qgp", action_noise=GAUSSIAN, **UNUSED
    ),
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
