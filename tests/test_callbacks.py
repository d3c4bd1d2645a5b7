"""The callback that saves states: its folder, what it refuses before a training begins, and the log of a resumed training."""

import copy
import time
from enum import Enum, IntEnum

import numpy as np
import pytest
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import CallbackList, EvalCallback, EveryNTimesteps
from stable_baselines3.common.env_util import make_vec_env
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from trainings import Do, make_model

from sb3_cgp import CGP
from sb3_cgp.resumption import TrainingCheckpointCallback
from sb3_cgp.resumption.store import StateStore

pytestmark = pytest.mark.usefixtures("handler", "short_episodes")


def test_the_states_of_another_training_are_not_touched_by_a_resumed_one_either(tmp_path):
    make_model().learn(30, TrainingCheckpointCallback(10, tmp_path / "one"))
    make_model(seed=1).learn(60, TrainingCheckpointCallback(10, tmp_path / "other"))
    model = CGP.resume(tmp_path / "one", make_vec_env("Pendulum-v1"))
    with pytest.raises(ValueError, match=r"`path` is '.*other', but must be a folder without the states of another training"):
        model.learn(50, TrainingCheckpointCallback(10, tmp_path / "other"))
    assert StateStore(tmp_path / "other").steps() == [50, 60]
    model.learn(50, TrainingCheckpointCallback(10, tmp_path / "new"))
    assert StateStore(tmp_path / "new").load()[0] == 50


Level = IntEnum("Level", "LOW HIGH")
Key = Enum("Key", {"PHASE": "phase"}, type=str)


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        *((Level.HIGH, 2), (np.str_("a"), "a"), (type("Celsius", (float,), {})(3), 3.0), (Key.PHASE, "Key.PHASE")),
        *((True, True), (np.float32(0.1), np.float32(0.1)), (np.bool_(True), np.bool_(True)), (np.float64(2), np.float64(2))),
        *((np.datetime64("2020-01-01"), None), (object(), None)),
    ],
    ids=lambda value: type(value).__name__,
)
def test_a_pending_value_of_any_type_is_kept_or_left_out(value, expected, tmp_path):
    def log():
        model.logger.record(Key.PHASE, value, exclude="stdout")
        model.logger.record_mean("other", 3.0)

    model = make_model()
    model.learn(9, [TrainingCheckpointCallback(9, tmp_path), Do(9, log)], log_interval=100)
    kept = CGP.resume(tmp_path, make_vec_env("Pendulum-v1")).resumption["logger"]
    found = kept["name_to_value"].get("phase")
    assert (found, type(found)) == (expected, type(expected))
    assert kept["name_to_excluded"].get("phase") == (None if expected is None else ("stdout",))
    assert (kept["name_to_value"]["other"], kept["name_to_count"]) == (3.0, {"other": 1})


def test_several_callbacks_save_to_folders_of_their_own(tmp_path):
    model = make_model()
    callbacks = [
        TrainingCheckpointCallback(10, tmp_path / "often"),
        TrainingCheckpointCallback(20, tmp_path / "seldom", keep=9),
    ]
    model.learn(50, callbacks)
    model.learn(40, callbacks, reset_num_timesteps=False)
    assert StateStore(tmp_path / "often").steps() == [80, 90]
    assert StateStore(tmp_path / "seldom").steps() == [20, 40, 50, 60, 80, 90]


# Such a folder needs no lock, of which a warning would tell
@pytest.mark.filterwarnings("error")
def test_a_folder_that_cannot_be_written_to_is_noticed_before_the_training(tmp_path):
    (tmp_path / "file").write_text("")
    model = make_model()
    with pytest.raises(OSError, match=r"so that this was not written: '.*file/"):
        model.learn(30, TrainingCheckpointCallback(10, tmp_path / "file"))
    assert model.num_timesteps == 0


@pytest.mark.parametrize(
    "nest",
    [
        lambda callback: EveryNTimesteps(10, callback),
        lambda callback: EveryNTimesteps(10, CallbackList([callback])),
        lambda callback: EvalCallback(make_vec_env("Pendulum-v1"), callback_on_new_best=callback),
    ],
    ids=["event", "list", "best"],
)
def test_within_another_callback_it_is_refused(nest, tmp_path):
    model = make_model()
    with pytest.raises(
        ValueError, match=r"`parent` is .*, but must be None: give a TrainingCheckpointCallback to `learn` itself"
    ):
        model.learn(30, nest(TrainingCheckpointCallback(10, tmp_path)))
    assert model.num_timesteps == 0


class Prioritised(ReplayBuffer):
    """A buffer of somebody's own, with more to it than rows, and an argument that changes."""

    def __init__(self, *args, beta=0.5, **kwargs):
        super().__init__(*args, **kwargs)
        self.priorities, self.beta = np.ones(self.buffer_size), beta

    def add(self, *args):
        super().add(*args)
        self.beta += 0.25


class Tree(Prioritised):
    """With a part that is not plain data."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.tree = object()


def test_a_replay_buffer_is_saved_with_all_of_its_state_or_refused(tmp_path):
    model = make_model(replay_buffer_class=Prioritised)
    model.replay_buffer.priorities[3] = 7.0
    model.learn(30, TrainingCheckpointCallback(10, tmp_path / "plain"))
    resumed = CGP.resume(tmp_path / "plain", make_vec_env("Pendulum-v1"))
    assert np.array_equal(resumed.replay_buffer.priorities, model.replay_buffer.priorities)
    assert resumed.replay_buffer.beta == 0.5 + 30 * 0.25
    del resumed
    given = CGP.resume(tmp_path / "plain", make_vec_env("Pendulum-v1"), replay_buffer_kwargs=dict(beta=2.0))
    assert given.replay_buffer.beta == 2.0
    del given
    with pytest.raises(ValueError, match=r"`buffer_size` is 80, .* 150, as saved: replay_buffer.priorities .* shape \(150,\)"):
        CGP.resume(tmp_path / "plain", make_vec_env("Pendulum-v1"), buffer_size=80)
    with pytest.raises(ValueError, match=r"`replay_buffer\.tree` is <object .*, but must be plain data or an array where"):
        make_model(replay_buffer_class=Tree).learn(30, TrainingCheckpointCallback(10, tmp_path / "tree"))


def test_a_model_without_an_environment_is_refused_before_it_trains_its_policy(tmp_path):
    model = make_model().learn(30)
    model.env = None
    before = copy.deepcopy(model.policy.state_dict())
    with pytest.raises(ValueError, match="The value of `env` is None, but must be set, by `set_env`"):
        model.train_policy(5, callback=TrainingCheckpointCallback(10, tmp_path))
    assert all(before[name].equal(value) for name, value in model.policy.state_dict().items())


# A state of the last step that was written, and one before it, whose step is written again
@pytest.mark.parametrize("save_freq", [25, 60])
def test_tensorboard_goes_on_in_the_trainings_own_folder(tmp_path, save_freq):
    logs = str(tmp_path / "logs")
    arguments = dict(env="Pendulum-v1", tensorboard_log=logs)
    make_model(**arguments).learn(100, log_interval=1)
    stop = Do(86, lambda: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        make_model(**arguments).learn(100, [TrainingCheckpointCallback(save_freq, tmp_path / "state"), stop], log_interval=1)
    # The newest folder is another's
    make_model(**arguments).learn(30)
    # TensorBoard puts a folder's files into the order of the second in their names
    time.sleep(1)
    model = CGP.resume(tmp_path / "state", "Pendulum-v1").learn(100, log_interval=1)
    assert model.logger.dir == f"{logs}/CGP_2"
    curves = []
    for name in ("CGP_1", "CGP_2"):
        events = EventAccumulator(f"{logs}/{name}").Reload()
        tags = [tag for tag in events.Tags()["scalars"] if not tag.startswith("time/")]
        curves.append({tag: [(event.step, event.value) for event in events.Scalars(tag)] for tag in tags})
    assert curves[0] == curves[1]
    assert len(curves[0]["rollout/ep_rew_mean"]) == 4
    # A training after it has a folder of its own
    assert model.learn(25, log_interval=1).logger.dir == f"{logs}/CGP_4"
