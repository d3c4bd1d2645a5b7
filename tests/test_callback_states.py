"""A callback that is missing from a resumed training is named if it had counted something, and not otherwise."""

import copy
import sys
import threading
import warnings
from collections import Counter, defaultdict, deque
from dataclasses import dataclass, field

import mujoco
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    CheckpointCallback,
    ConvertCallback,
    EvalCallback,
    EveryNTimesteps,
    ProgressBarCallback,
    StopTrainingOnMaxEpisodes,
)
from stable_baselines3.common.env_util import make_vec_env
from tqdm import tqdm

from sb3_cgp import CGP, HParamsCallback, TrainingCheckpointCallback
from sb3_cgp.resumption.fingerprints import fingerprint

pytestmark = pytest.mark.usefixtures("short_episodes")

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


class Compiled(mujoco.MjOption, Watch, metaclass=type("Metaclass", (type(mujoco.MjOption), type(Watch)), {})):
    """Derives from a class whose constructor, which is not written in Python, does not tell its arguments."""

    def __init__(self, *args, **kwargs):
        mujoco.MjOption.__init__(self)
        Watch.__init__(self, *args, **kwargs)


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


@dataclass
class Statistics:
    """An object of a class of the user's own, within which something is counted."""

    lengths: list = field(default_factory=list)
    model: object = None


class Keeping(BaseCallback):
    """Keeps an object, which it changes at each step, or else notes when the training starts."""

    def __init__(self, kept, count=None):
        super().__init__()
        self.kept, self.count = kept, count

    def _on_training_start(self):
        if self.count is None:
            self.start, self.scratch = threading.get_ident(), {"at": self.num_timesteps}
        if isinstance(self.kept, Statistics):
            self.kept.model = self.model

    def _on_step(self):
        if self.count is not None:
            self.count(self.kept)
        return True


def missing(callback, folder, steps=60, **arguments):
    """Resume a training without a callback that the first part had; return the warnings about it."""
    model = CGP("MlpPolicy", "Pendulum-v1", **TINY, **arguments)
    model.learn(steps, callback=[TrainingCheckpointCallback(min(steps, 20), folder), callback])
    del model
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        CGP.resume(folder, "Pendulum-v1").learn(steps + 20)
    return [str(each.message) for each in warned if "was among the callbacks, and is not now" in str(each.message)]


@pytest.mark.usefixtures("in_tmp_path")
@pytest.mark.parametrize(
    "callback",
    [
        HParamsCallback(),
        Watch(),
        Watch(counts_from=1_000),
        Compiled(),
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
        model.learn(24, callback=[TrainingCheckpointCallback(12, tmp_path), callback])
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            CGP.resume(tmp_path, "Pendulum-v1").learn(40)
        return
    assert missing(callback, tmp_path) == []


@pytest.mark.parametrize(
    "callback",
    [
        Watch(counts_from=30),
        Declaring({"seen": 3}),
        EveryNTimesteps(7, HParamsCallback()),
        StopTrainingOnMaxEpisodes(99),
        EvalCallback(make_vec_env("Pendulum-v1"), eval_freq=30, n_eval_episodes=1, verbose=0),
    ],
    ids=lambda each: type(each).__name__,
)
def test_a_callback_that_has_counted_is_missed_by_name(callback, tmp_path):
    (message,) = missing(callback, tmp_path)
    assert (
        f"A {type(callback).__module__}.{type(callback).__qualname__} was among the callbacks, and is not now: what" in message
    )


@pytest.mark.parametrize(
    "callback",
    [*map(Keeping, (None, Counter(a=1), th.ones(2), Statistics(), sys.stderr, threading.Lock())), ProgressBarCallback()],
    ids=lambda each: type(getattr(each, "kept", each)).__name__,
)
@pytest.mark.filterwarnings("ignore:rich is experimental")
def test_a_callback_that_keeps_an_object_and_does_not_change_it_is_not_missed(callback, tmp_path):
    assert missing(callback, tmp_path, steps=8) == []


@pytest.mark.parametrize(
    ("kept", "count"),
    [
        (Counter(), lambda kept: kept.update("a")),
        (defaultdict(lambda: 0), lambda kept: kept.update(a=kept["a"] + 1)),
        (deque(maxlen=3), lambda kept: kept.append(len(kept))),
        (type("Own", (list,), {})(), lambda kept: kept.append(None)),
        (th.zeros(2), lambda kept: kept.add_(1)),
        (th.nn.Linear(1, 1), lambda kept: th.nn.init.zeros_(kept.weight)),
        (Statistics(), lambda kept: kept.lengths.append(1)),
        ({"within": [Statistics()]}, lambda kept: kept["within"][0].lengths.append(1)),
        ([], lambda kept: kept.append(1)),
    ],
    ids=lambda each: type(each).__name__,
)
def test_what_a_callback_counts_in_any_object_is_missed(kept, count, tmp_path):
    assert len(missing(Keeping(kept, count), tmp_path, steps=8)) == 1


def test_what_was_counted_before_the_offline_training_of_a_policy_counts(tmp_path, monkeypatch):
    monkeypatch.setattr("sb3_cgp.core.offline.ROUND", 10)
    # Its value does not change in the training of the policy, which begins the callbacks anew
    assert len(missing(Watch(counts_from=60), tmp_path, policy_training="offline")) == 1


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
def test_the_fingerprint_of_a_value_is_that_of_a_copy_and_of_nothing_else(value):
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
    assert fingerprint(value) == fingerprint(copy.deepcopy(value)) is not None
    assert fingerprint(value) not in map(fingerprint, others)


class Deriving(BaseCallback):
    """Derives attributes from its arguments, and counts its initialisations and steps."""

    def __init__(self, folder, limit):
        super().__init__()
        self.path = f"{folder}/best"
        self.threshold = 2 * limit
        self.seen = self.initialised = 0

    def _init_callback(self):
        self.initialised += 1

    def _on_step(self):
        self.seen += 1
        return True


@pytest.mark.parametrize("with_checkpoint", [True, False])
def test_what_a_callback_derives_from_its_arguments_follows_the_new_ones(with_checkpoint, tmp_path):
    def checkpoint():
        return TrainingCheckpointCallback(10, tmp_path / "state")

    model = CGP("MlpPolicy", "Pendulum-v1", **TINY)
    model.learn(30, [Deriving("old", 3), StopTrainingOnMaxEpisodes(2), checkpoint()])
    assert model.num_timesteps == 30
    new, stop = Deriving("new", 4), StopTrainingOnMaxEpisodes(4)
    model = CGP.resume(tmp_path / "state", "Pendulum-v1")
    model.learn(150, [new, stop, *([checkpoint()] if with_checkpoint else [])])
    assert (new.path, new.threshold) == ("new/best", 8)
    # What was counted goes on
    assert new.seen == model.num_timesteps == 4 * 25
    assert new.initialised == 1


def test_what_a_callback_has_from_an_earlier_training_is_kept(tmp_path):
    def train(model, callback, steps, **kwargs):
        model.learn(steps, [callback, TrainingCheckpointCallback(10, tmp_path / "state")], **kwargs)

    first, model = Watch(counts_from=20), CGP("MlpPolicy", "Pendulum-v1", **TINY)
    model.learn(30, first)
    found = first.found
    # Nothing changes in the second training
    first.counts_from = None
    train(model, first, 20, reset_num_timesteps=False)
    again = Watch()
    CGP.resume(tmp_path / "state", "Pendulum-v1").learn(20, again, reset_num_timesteps=False)
    assert again.found == found == {"steps": [30]}


class Losing(BaseCallback, dict):
    """Changes what can be saved and what cannot: objects of other classes, and its arguments."""

    def __init__(self, results, patience=3):
        BaseCallback.__init__(self)
        self.results, self.patience = results, patience
        self.counts, self.lengths, self.own, self.same = Counter(), defaultdict(list), defaultdict(lambda: 0), Statistics()
        self.tensor = self.function = None

    def _on_step(self):
        self.counts["steps"] += 1
        self.lengths["all"].append(self.num_timesteps)
        self.own["steps"] += 1
        self.tensor, self.function = th.ones(1), len
        self.results.append(self.num_timesteps)
        self.patience -= 1
        return True


def test_what_a_callback_has_changed_and_cannot_be_saved_is_named_once(tmp_path):
    with pytest.warns(UserWarning, match="is not saved") as warned:
        CGP("MlpPolicy", "Pendulum-v1", **TINY).learn(20, [Losing([]), TrainingCheckpointCallback(10, tmp_path / "state")])
    messages = [str(each.message) for each in warned if "is not saved" in str(each.message)]
    reasons = {message.split("`")[1]: message for message in messages}
    assert list(reasons) == ["own", "patience", "results", "tensor"]
    assert len(messages) == 4
    assert "as it is a defaultdict, not plain data. A resumed" in reasons["own"]
    assert "as it is a Tensor, not plain data. A resumed" in reasons["tensor"]
    assert "as it is an argument of its constructor. A resumed" in reasons["patience"]
    assert "define get_training_state() and set_training_state()." in reasons["results"]
    again = Losing([])
    CGP.resume(tmp_path / "state", "Pendulum-v1").learn(30, again)
    assert (again.counts, again.lengths) == (Counter(steps=30), {"all": [*range(1, 31)]})
    assert type(again.lengths) is defaultdict
    # As the warning says
    assert (again.own, again.results) == ({"steps": 10}, [*range(21, 31)])


def test_a_callback_that_is_given_after_the_trainings_start_is_said_to_have_lost_nothing(tmp_path):
    class Adding(Watch):
        def _on_step(self):
            if self.n_calls == 15:
                self.late = Watch()
                self.late.init_callback(self.model)
            return True

    adding = Adding()
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*is not saved")
        CGP("MlpPolicy", "Pendulum-v1", **TINY).learn(20, [adding, TrainingCheckpointCallback(10, tmp_path)])
    assert adding.late.model is adding.model


def test_progress_bars_of_a_callback_are_not_missed(tmp_path):
    class Showing(BaseCallback):
        def _on_training_start(self):
            self.bar = tqdm(disable=True)
            self.bar.n = 0

        def _on_step(self):
            self.bar.n += 1
            return True

    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*is not saved")
        CGP("MlpPolicy", "Pendulum-v1", **TINY).learn(20, [Showing(), TrainingCheckpointCallback(10, tmp_path)])


def test_declared_states_may_be_anything_that_is_plain_data(tmp_path):
    class Random(Declaring):
        def set_training_state(self, state):
            self.state = state

    state = {"generator": np.random.default_rng(3), "seen": deque([1, 2], maxlen=3), "kinds": {"a"}}
    CGP("MlpPolicy", "Pendulum-v1", **TINY).learn(20, [Random(state), TrainingCheckpointCallback(10, tmp_path / "state")])
    expected, restored = state["generator"].random(), Random(None)
    CGP.resume(tmp_path / "state", "Pendulum-v1").learn(30, restored)
    assert restored.state["generator"].random() == expected
    assert (restored.state["seen"], restored.state["kinds"]) == (deque([1, 2], maxlen=3), {"a"})
    with pytest.raises(ValueError, match=r"Random.get_training_state\(\) returned .*object.*, but must return plain data"):
        CGP("MlpPolicy", "Pendulum-v1", **TINY).learn(
            20, [Random({"other": object()}), TrainingCheckpointCallback(10, tmp_path / "other")]
        )
