"""Arguments of a wrong name or type are refused when the method is called, before the environment steps."""

import io
import re
import warnings

import numpy as np
import pytest
from guarded import SMALL, GuardedTD3, located
from small_models import make_model
from stable_baselines3 import TD3
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    CheckpointCallback,
    ConvertCallback,
    EvalCallback,
    EveryNTimesteps,
    StopTrainingOnMaxEpisodes,
)

from sb3_cgp import CGP, HParamsCallback, TrainingCheckpointCallback
from sb3_cgp.population import Population
from sb3_cgp.resumption import resumable

TINY = dict(policy_kwargs=dict(net_arch=[4]), buffer_size=50, learning_starts=5, batch_size=4, device="cpu")


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    path = tmp_path_factory.mktemp("saved") / "model"
    model = CGP("MlpPolicy", "Pendulum-v1", **TINY)
    model.note_of_the_user = "first"
    model.save(path)
    return path


@pytest.mark.parametrize(
    ("given", "similar"),
    [("infrence", "inference"), ("learning_rat", "learning_rate"), ("custom_object", "custom_objects"), ("evn", "env")],
)
def test_a_misspelt_keyword_of_load_is_refused_with_the_nearest_one(given, similar, saved):
    message = rf"The value of `{given}` is 'cem', but `CGP.load` takes no such argument\. Did you mean `{similar}`\?"
    with pytest.raises(TypeError, match=message):
        CGP.load(saved, **{given: "cem"})


def test_a_keyword_similar_to_none_is_refused_with_all_names(saved):
    with pytest.raises(TypeError, match=r"takes no such argument\. It takes custom_objects, .*action_noise, .*cem_samples"):
        CGP.load(saved, zzz=1)


@pytest.mark.parametrize("name", ["logger", "train", "actor_lr_schedule"])
def test_a_method_or_property_which_load_cannot_change_is_refused(name, saved):
    with pytest.raises(TypeError, match=f"The value of `{name}` is None, but `CGP.load` takes no such argument"):
        CGP.load(saved, **{name: None})


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("inference", "cem"),
        ("cem_samples", 32),
        ("seed", 7),
        ("verbose", 1),
        ("n_envs", 1),
        ("_n_updates", 9),
        ("num_timesteps", 12),
        ("replay_buffer", None),
        ("note_of_the_user", "second"),
    ],
)
def test_constructor_arguments_and_attributes_can_be_changed_by_load(name, value, saved):
    assert getattr(CGP.load(saved, **{name: value}), name) == value


@pytest.mark.parametrize("n_envs", [2, "1"])
def test_a_number_that_is_not_the_environments_is_refused_by_load(n_envs, saved, tmp_path):
    message = rf"`n_envs` is {n_envs!r}, but must be left out, or 1, as many as `env` has"
    with pytest.raises(ValueError, match=message):
        CGP.load(saved, make_model().get_env(), n_envs=n_envs)
    population = Population("MlpPolicy", "Pendulum-v1", 1, buffer_size=100, policy_kwargs=dict(net_arch=[4]))
    population.save(tmp_path / "population")
    with pytest.raises(ValueError, match=message):
        Population.load(tmp_path / "population", "Pendulum-v1", n_envs=n_envs)


def test_an_open_file_is_read_from_its_position(saved):
    content = saved.with_suffix(".zip").read_bytes()
    file = io.BytesIO(content)
    with pytest.raises(TypeError, match="`infrence`"):
        CGP.load(file, infrence="cem")
    assert file.tell() == 0
    assert CGP.load(file, note_of_the_user="second").note_of_the_user == "second"


def test_a_missing_or_damaged_file_is_refused_as_by_sb3(tmp_path):
    (tmp_path / "damaged.zip").write_text("no zip")
    for arguments in (dict(), dict(infrence="cem"), dict(custom_objects=dict(learning_rate=0.0))):
        with pytest.raises(FileNotFoundError):
            CGP.load(tmp_path / "missing", **arguments)
        with pytest.raises(ValueError, match="wasn't a zip-file"):
            CGP.load(tmp_path / "damaged.zip", **arguments)


def test_the_window_of_the_log_is_changed_by_load(saved):
    """SB3 keeps the argument under another name, and ignores it in ``load``."""
    model = CGP.load(saved, make_model().get_env(), stats_window_size=7)
    assert model.learn(6).ep_info_buffer.maxlen == 7


def test_a_policy_given_to_load_has_no_effect_which_is_warned_of(saved):
    with pytest.warns(UserWarning, match="`policy='CnnPolicy'` has no effect: a loaded model keeps the policy"):
        CGP.load(saved, policy="CnnPolicy")


def test_a_misspelt_custom_object_is_warned_of_and_those_of_other_algorithms_are_not(saved):
    with pytest.warns(UserWarning, match=r"custom_objects\['learning_rat'\] has no effect, .*'learning_rate'\?"):
        CGP.load(saved, custom_objects=dict(learning_rat=0.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Those of rl_zoo3
        CGP.load(saved, custom_objects=dict(learning_rate=0.0, lr_schedule=lambda _: 0.0, clip_range=lambda _: 0.0))


def test_load_of_other_algorithms_is_guarded_too(tmp_path):
    GuardedTD3("MlpPolicy", located(), **SMALL).save(tmp_path / "model")
    assert GuardedTD3.load(tmp_path / "model", policy_delay=3, use_sde=False).policy_delay == 3
    with pytest.raises(TypeError, match=r"`GuardedTD3.load` takes no such argument\. Did you mean `policy_delay`\?"):
        GuardedTD3.load(tmp_path / "model", polcy_delay=3)


@pytest.mark.parametrize("algorithm", [CGP, resumable(TD3)])
def test_a_misspelt_keyword_of_resume_is_refused_and_the_folder_is_free_again(algorithm, tmp_path):
    model = algorithm("MlpPolicy", "Pendulum-v1", **TINY)
    model.learn(8, callback=TrainingCheckpointCallback(save_freq=4, path=tmp_path))
    del model
    with pytest.raises(
        TypeError, match=rf"`{algorithm.__name__}.resume` takes no such argument\. Did you mean `batch_size`\?"
    ):
        algorithm.resume(tmp_path, "Pendulum-v1", bach_size=8)
    assert algorithm.resume(tmp_path, "Pendulum-v1", batch_size=8, print_system_info=False).batch_size == 8


def test_misspelt_arguments_of_a_population_are_refused_with_the_nearest_one(tmp_path):
    with pytest.raises(ValueError, match=r"`arguments` is 'infrence', .*; the nearest name is `inference`"):
        Population("MlpPolicy", "Pendulum-v1", 2, infrence="cem")
    Population("MlpPolicy", "Pendulum-v1", 2, **TINY).save(tmp_path / "agents")
    with pytest.raises(TypeError, match=r"`Population.load` takes no such argument\. Did you mean `verbose`\?"):
        Population.load(tmp_path / "agents", verbos=1)
    with pytest.raises(ValueError, match="`agents` is 3, but must be left out"):
        Population.load(tmp_path / "agents", agents=3)
    assert Population.load(tmp_path / "agents", verbose=1).verbose == 1


@pytest.mark.parametrize("value", ["100", None, 100.5, -5, True, float("nan"), float("inf"), [100]])
def test_a_number_of_steps_that_is_no_count_is_refused_before_the_environment_resets(value):
    model = make_model()
    with pytest.raises(ValueError, match=rf"`total_timesteps` is {re.escape(repr(value))}, but must be an integer >= 0"):
        model.learn(value)
    assert model._last_obs is None


@pytest.mark.filterwarnings("ignore:Nothing is learnt")
@pytest.mark.parametrize("value", [8, 8.0, np.int64(8), np.float32(8)])
def test_a_number_of_steps_may_be_an_integral_float_as_in_sb3(value):
    assert make_model().learn(value).num_timesteps == 8


def in_slots(callback):
    return [callback], CallbackList([callback]), EveryNTimesteps(4, callback), CallbackList([EveryNTimesteps(4, callback)])


@pytest.mark.parametrize("callback", [HParamsCallback, StopTrainingOnMaxEpisodes, BaseCallback])
def test_a_class_in_the_place_of_a_callback_is_refused_wherever_it_stands(callback):
    model = make_model()
    remedy = rf"must be an instance of a subclass of BaseCallback.*: write `{callback.__name__}\(\.\.\.\)`, with its arguments"
    evaluation = EvalCallback(model.get_env(), callback_on_new_best=callback)
    for given in (callback, *in_slots(callback), evaluation):
        with pytest.raises(ValueError, match=remedy):
            model.learn(8, callback=given)
    assert model._last_obs is None


@pytest.mark.parametrize("callback", [5, "HParamsCallback", (CheckpointCallback(4, "unused"),), [lambda *_: True], [None]])
def test_anything_that_is_no_callback_is_refused(callback):
    with pytest.raises(ValueError, match=r"The value of `callback(\[0\])?` is .*, but must be an instance of a subclass of"):
        make_model().learn(8, callback=callback)


@pytest.mark.filterwarnings("ignore:Nothing is learnt")
def test_callbacks_that_sb3_takes_are_taken():
    """Also one that holds the class of another for a use of its own."""
    keeper = ConvertCallback(lambda *_: True)
    keeper.kind = CheckpointCallback
    evaluation = EvalCallback(make_model().get_env(), eval_freq=100)
    evaluation.callbacks = [print]
    for callback in (None, [], lambda local, globals_: True, keeper, evaluation, *in_slots(keeper)):
        assert make_model().learn(8, callback=callback).num_timesteps == 8


def test_a_class_in_the_place_of_a_callback_is_refused_in_every_training():
    model = make_model(learning_starts=5, policy_training="offline")
    with pytest.raises(ValueError, match=r"`callback` is .*HParamsCallback"):
        model.train_policy(max_steps=1, callback=HParamsCallback)
    with pytest.raises(ValueError, match=r"`callback` is .*HParamsCallback"):
        Population("MlpPolicy", "Pendulum-v1", 2, **TINY).learn(8, callback=HParamsCallback)
    with pytest.raises(ValueError, match="`total_timesteps` is '8'"):
        Population("MlpPolicy", "Pendulum-v1", 2, **TINY).learn("8")


@pytest.mark.parametrize("value", [0, "4"])
def test_an_interval_of_the_log_that_sb3_fails_on_at_the_end_of_an_episode_is_refused(value):
    with pytest.raises(
        ValueError, match=f"`log_interval` is {value!r}, but must be a number of episodes other than 0, or None"
    ):
        make_model().learn(8, log_interval=value)


@pytest.mark.parametrize("algorithm", [CGP, GuardedTD3, Population])
def test_a_misspelt_policy_is_refused_with_the_nearest_name(algorithm):
    with pytest.raises(ValueError, match=r"`policy` is 'MlpPolcy', but must be one of 'MlpPolicy', .*mean 'MlpPolicy'\?"):
        algorithm("MlpPolcy", "Pendulum-v1")
    with pytest.raises(ValueError, match=r"`policy` is 'zzz', but must be one of .*, or a class of policies\.$"):
        algorithm("zzz", "Pendulum-v1")


@pytest.mark.parametrize("algorithm", [CGP, GuardedTD3])
def test_a_policy_that_is_no_class_is_refused(algorithm):
    with pytest.raises(ValueError, match="`policy` is 5, but must be a class of policies, or one of 'MlpPolicy', 'CnnPolicy'"):
        algorithm(5, "Pendulum-v1")


@pytest.mark.parametrize("algorithm", [CGP, GuardedTD3])
@pytest.mark.parametrize(("value", "n_updates"), [(4, 5), ((10, "step"), 2), ((1, "episode"), 3)])
def test_train_freq_that_is_set_on_a_model_takes_effect(algorithm, value, n_updates):
    model = algorithm("MlpPolicy", located(), **SMALL | dict(learning_starts=0, gradient_steps=1)).learn(3)
    n_before = model._n_updates
    model.train_freq = value
    assert model.learn(20)._n_updates - n_before == n_updates


@pytest.mark.parametrize("value", [0, 4.0, (4, "minutes"), "episode", (1, "episode")])
def test_a_wrong_train_freq_that_is_set_on_a_model_is_refused_by_name(value):
    model = GuardedTD3("MlpPolicy", located(2), **SMALL)
    model.train_freq = value
    with pytest.raises(ValueError, match=re.escape(f"The value of `train_freq` is {value!r}")):
        model.learn(20)
    assert model.num_timesteps == 0
