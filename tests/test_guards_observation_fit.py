"""Observations that their space cannot hold, which NumPy would change, are refused before they are stored."""

import re

import numpy as np
import pytest
from faulty_environments import SMALL, Failing, with_observation
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor, VecNormalize

from sb3_cgp import CGP
from sb3_cgp.common.spaces import by_key
from sb3_cgp.population import ChunkedSubprocVecEnv

PIXELS = spaces.Box(0, 255, (2, 3), np.uint8)
PIXELS_BY_KEY = spaces.Dict(image=PIXELS, speed=spaces.Box(-1, 1, (2,)))
N_GOOD = 13


class Integers(Failing):
    """Observations of any space until one is made by the fault."""

    def observe(self):
        return self.observation_space.sample()


def make_env(space, fault, vec_env_class=DummyVecEnv):
    kwargs = dict(start_method="fork") if vec_env_class is SubprocVecEnv else {}
    return vec_env_class([lambda: Integers(fault, N_GOOD, observation_space=space)], **kwargs)


def make_model(env):
    return CGP("MultiInputPolicy" if isinstance(env.observation_space, spaces.Dict) else "MlpPolicy", env, **SMALL)


def image(value, dtype=np.float64):
    pixels = np.zeros((2, 3), dtype)
    pixels[1, 2] = value
    return pixels


REFUSED = {
    "scaled": (PIXELS, image(0.5), r"value 0.5 at index \(.*1, 2\), .* has integers from 0 to 255\..*has to set its own"),
    "too large": (PIXELS, image(300, np.int64), "value 300 at"),
    "negative": (PIXELS, image(-1, np.int8), "value -1 at"),
    "NaN": (PIXELS, image(np.nan), "value nan at"),
    "by key": (PIXELS_BY_KEY, {"image": image(0.5), "speed": np.zeros(2)}, "observation `image` that .* value 0.5 at"),
    "signed": (spaces.Box(-9, 9, (2,), np.int8), np.array([0.0, 1e30]), r"value 1e\+30 at"),
    "Discrete": (spaces.Discrete(5), 5, "value 5 at .* from 0 to 4"),
    "Discrete, negative": (spaces.Discrete(5), -1, "value -1 at"),
    "MultiDiscrete": (spaces.MultiDiscrete([3, 4]), np.array([2, 4]), "value 4 at .* from 0 to 3"),
    "MultiDiscrete, scalar": (spaces.MultiDiscrete([3]), 5, r"value 5 at index \(0,\), .* from 0 to 2"),
    "MultiBinary": (spaces.MultiBinary(2), np.array([0, 2]), "value 2 at .* from 0 to 1"),
    "without a key": (PIXELS_BY_KEY, {"image": image(1)}, r"incomplete .*: \['image'\], .* the keys \['image', 'speed'\]"),
    "no dictionary": (PIXELS_BY_KEY, np.zeros(2), "incomplete .*: ndarray without keys"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_an_observation_that_does_not_fit_is_refused(name):
    space, observation, message = REFUSED[name]
    model = make_model(make_env(space, with_observation(observation)))
    with pytest.raises(ValueError, match=f"(?s){message}"):
        model.learn(40)
    assert model.replay_buffer.size() == N_GOOD - 1


@pytest.mark.parametrize("name", ["scaled", "Discrete", "without a key"])
def test_one_from_a_worker_is_refused_too(name):
    space, observation, message = REFUSED[name]
    env = make_env(space, with_observation(observation), SubprocVecEnv)
    with pytest.raises(ValueError, match="without the key 'speed' of its space" if name == "without a key" else message):
        make_model(env).learn(40)
    env.close()


@pytest.mark.parametrize("name", REFUSED)
def test_one_from_a_process_of_several_environments_is_refused_there(name, capfd):
    """The process collects observations as a ``DummyVecEnv`` does, so that the main process would see them rounded."""
    space, observation, message = REFUSED[name]
    faults = [with_observation(observation), None]
    env_fns = [lambda fault=fault: Integers(fault, N_GOOD, observation_space=space) for fault in faults]
    env = ChunkedSubprocVecEnv(env_fns, n_processes=1, start_method="fork")
    model = make_model(env)
    with pytest.raises(RuntimeError, match="An exception in it is printed above"):
        model.learn(80)
    assert model.replay_buffer.size() == N_GOOD - 1
    assert re.search(rf"(?s)ValueError: The .*{message}", capfd.readouterr().err)


@pytest.mark.parametrize("wrap", [lambda env: env, VecMonitor, VecNormalize], ids=["bare", "VecMonitor", "VecNormalize"])
def test_the_last_one_of_an_episode_is_refused_too(wrap):
    end = lambda observation, reward, *_: (image(0.5), reward, True, False, {})  # noqa: E731
    with pytest.raises(ValueError, match=r"terminal observation that .* value 0.5 at index \(1, 2\)"):
        make_model(wrap(make_env(PIXELS, end))).learn(40)


@pytest.mark.parametrize(
    ("space", "observation"),
    [
        (PIXELS, image(255.0)),
        (PIXELS, image(7, np.int64)),
        (spaces.Box(0, 9, (2,), np.int32), np.array([-5, 12], np.int16)),
        (spaces.Box(0, 1, (2,), np.bool_), np.array([0, 1])),
        (spaces.Discrete(5), np.int8(4)),
        (spaces.MultiDiscrete([3, 4]), [2, 3]),
        (spaces.MultiBinary(2), np.array([True, False])),
        (PIXELS_BY_KEY, {"image": image(255.0), "speed": np.zeros(2), "more": None}),
    ],
    ids=str,
)
def test_whole_numbers_of_any_type_are_taken_as_they_are(space, observation):
    model = make_model(make_env(space, with_observation(observation))).learn(30)
    stored = by_key(model.replay_buffer.next_observations)
    for key in by_key(space):
        expected = by_key(observation)[key]
        np.testing.assert_array_equal(stored[key][N_GOOD - 1].flatten(), np.asarray(expected).flatten())
