"""A callback that is missing from a resumed training is named if it had counted something, and not otherwise."""

import warnings

import numpy as np
import pytest
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    CheckpointCallback,
    ConvertCallback,
    EvalCallback,
    EveryNTimesteps,
    StopTrainingOnMaxEpisodes,
)
from stable_baselines3.common.env_util import make_vec_env

from sb3_cgp import CGP, HParamsCallback, TrainingCheckpointCallback
from sb3_cgp.resumption.plain_data import equal_plain, to_plain

TINY = dict(learning_starts=5, batch_size=4, buffer_size=300, policy_kwargs=dict(net_arch=[4]), device="cpu", seed=0)


class Watch(BaseCallback):
    """Has arguments and constants, counts only from a step on, and keeps what is no plain data."""

    def __init__(self, counts_from=None):
        super().__init__()
        self.counts_from = counts_from
        self.every = 10
        self.edges = np.array([0.0, np.nan])
        self.best = float("nan")
        self.found = None
        self.file = object()

    def _on_step(self):
        if self.counts_from is not None and self.num_timesteps >= self.counts_from:
            self.found = {"steps": [self.num_timesteps]}
        return True


class Declaring(BaseCallback):
    """Declares its state."""

    def __init__(self, state):
        super().__init__()
        self.state = state
        self.seen = 0

    def get_training_state(self):
        return self.state

    def set_training_state(self, state):
        self.state = state

    def _on_step(self):
        self.seen += 1
        return True


def missing(callback, folder, **arguments):
    """Resume a training without a callback that the first part had; return the warnings about it."""
    model = CGP("MlpPolicy", "Pendulum-v1", **TINY, **arguments)
    model.learn(220, callback=[TrainingCheckpointCallback(20, folder), callback])
    del model
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        CGP.resume(folder, "Pendulum-v1").learn(240)
    return [str(each.message) for each in warned if "was among the callbacks, and is not now" in str(each.message)]


@pytest.mark.parametrize(
    "callback",
    [
        HParamsCallback(),
        Watch(),
        Watch(counts_from=1_000),
        Declaring({}),
        Declaring(None),
        Declaring({"n_calls": 3, "num_timesteps": 3}),
        ConvertCallback(lambda *_: True),
        CallbackList([HParamsCallback()]),
        CheckpointCallback(1_000, "unused"),
        StopTrainingOnMaxEpisodes(99),
    ],
    ids=lambda each: type(each).__name__,
)
def test_a_callback_that_has_counted_nothing_is_not_missed(callback, tmp_path):
    if isinstance(callback, StopTrainingOnMaxEpisodes):
        # No episode has ended when the state is saved
        model = CGP("MlpPolicy", "Pendulum-v1", **TINY)
        model.learn(40, callback=[TrainingCheckpointCallback(20, tmp_path), callback])
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            CGP.resume(tmp_path, "Pendulum-v1").learn(60)
        return
    assert missing(callback, tmp_path) == []


@pytest.mark.parametrize(
    "callback",
    [
        Watch(counts_from=100),
        Declaring({"seen": 3}),
        EveryNTimesteps(7, HParamsCallback()),
        StopTrainingOnMaxEpisodes(99),
        EvalCallback(make_vec_env("Pendulum-v1"), eval_freq=100, n_eval_episodes=1, verbose=0),
    ],
    ids=lambda each: type(each).__name__,
)
def test_a_callback_that_has_counted_is_missed_by_name(callback, tmp_path):
    (message,) = missing(callback, tmp_path)
    assert (
        f"A {type(callback).__module__}.{type(callback).__qualname__} was among the callbacks, and is not now: what" in message
    )


def test_what_was_counted_before_the_offline_training_of_a_policy_counts(tmp_path, monkeypatch):
    monkeypatch.setattr("sb3_cgp.core.offline.ROUND", 10)
    # Its value does not change in the training of the policy, which begins the callbacks anew
    assert len(missing(Watch(counts_from=220), tmp_path, policy_training="offline")) == 1


def test_what_was_counted_before_a_resumption_counts(tmp_path):
    class Once(BaseCallback):
        found = 0

        def _on_step(self):
            if self.num_timesteps == 10:
                self.found = 1
            return True

    CGP("MlpPolicy", "Pendulum-v1", **TINY).learn(20, callback=[TrainingCheckpointCallback(20, tmp_path), Once()])
    CGP.resume(tmp_path, "Pendulum-v1").learn(40, callback=Once())
    with pytest.warns(UserWarning, match="Once was among the callbacks"):
        CGP.resume(tmp_path, "Pendulum-v1").learn(60)


@pytest.mark.parametrize(
    "value", [None, 3, 0.5, float("nan"), "a", b"a", np.float32(1), np.array([1.0, np.nan]), [1, (2, {})]]
)
def test_plain_data_is_equal_to_itself_and_to_nothing_else(value):
    others = [
        1,
        1.0,
        True,
        "b",
        [1],
        (1,),
        [1, (2, {"a": 1})],
        {"a": 1},
        np.array([1.0, 2.0]),
        np.array([1, 2]),
        np.float64(1),
    ]
    assert equal_plain(to_plain(value), to_plain(value))
    assert not any(equal_plain(to_plain(value), to_plain(other)) for other in others)
