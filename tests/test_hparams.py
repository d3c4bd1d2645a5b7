"""TensorBoard's tab HParams: what TensorBoard itself reads from the events of trainings."""

import sys

import numpy as np
import pytest
import torch as th
from rl_zoo3.train import train
from stable_baselines3 import DDPG, PPO, SAC, TD3
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule
from tensorboard.backend.event_processing.data_provider import MultiplexerDataProvider
from tensorboard.backend.event_processing.plugin_event_multiplexer import EventMultiplexer
from tensorboard.context import RequestContext
from tensorboard.plugins.base_plugin import TBContext
from tensorboard.plugins.hparams import api_pb2
from tensorboard.plugins.hparams.backend_context import Context
from tensorboard.plugins.hparams.get_experiment import Handler as ExperimentHandler
from tensorboard.plugins.hparams.list_session_groups import Handler as SessionsHandler

from sb3_cgp import CGP, HParamsCallback, Selection
from sb3_cgp.hparams import hyperparameters
from sb3_cgp.population import Population
from sb3_cgp.resumption.algorithm import resumable
from sb3_cgp.zoo import register


def tiny(**arguments):
    """Arguments of a small model; SB3 changes ``policy_kwargs``."""
    small = dict(learning_starts=20, buffer_size=100, batch_size=8, policy_kwargs=dict(net_arch=[4]), device="cpu", seed=0)
    return small | arguments


class Tab:
    """The tab HParams of a folder, by TensorBoard's own server."""

    def __init__(self, folder):
        multiplexer = EventMultiplexer().AddRunsFromDirectory(str(folder)).Reload()
        provider = MultiplexerDataProvider(multiplexer, str(folder))
        context = Context(TBContext(logdir=str(folder), multiplexer=multiplexer, data_provider=provider))
        request = api_pb2.GetExperimentRequest(include_metrics=True)
        self.experiment = ExperimentHandler(RequestContext(), context, "", request).run()
        columns = [api_pb2.ColParams(metric=info.name, include_in_result=True) for info in self.experiment.metric_infos]
        columns += [api_pb2.ColParams(hparam=info.name, include_in_result=True) for info in self.experiment.hparam_infos]
        statuses = [api_pb2.STATUS_SUCCESS, api_pb2.STATUS_UNKNOWN, api_pb2.STATUS_RUNNING]
        request = api_pb2.ListSessionGroupsRequest(
            col_params=columns, allowed_statuses=statuses, slice_size=100, include_metrics=True
        )
        self.groups = SessionsHandler(RequestContext(), context, "", request).run().session_groups

    def rows(self):
        return [
            {name: getattr(value, value.WhichOneof("kind")) for name, value in group.hparams.items()} for group in self.groups
        ]

    def metrics(self):
        return [{value.name.tag: value.value for value in group.metric_values} for group in self.groups]


def learn(folder, algorithm=CGP, steps=60, callbacks=(), **arguments):
    model = algorithm("MlpPolicy", "Pendulum-v1", tensorboard_log=folder, **tiny(**arguments))
    return model.learn(steps, [HParamsCallback(), *callbacks], log_interval=1)


def test_a_row_has_the_arguments_and_the_last_evaluation(tmp_path):
    evaluation = EvalCallback(make_vec_env("Pendulum-v1", seed=1), n_eval_episodes=1, eval_freq=100, verbose=0)
    learn(tmp_path, steps=400, callbacks=[evaluation], cem_samples=16, cem_elites=3, gamma=0.98)
    tab = Tab(tmp_path)
    (row,) = tab.rows()
    expected = {"algorithm": "CGP", "policy": "CGPPolicy", "n_envs": 1, "seed": 0, "policy_loss": "cgp", "gamma": 0.98}
    expected |= {"cem_iterations": 2, "cem_samples": 16, "cem_elites": 3, "cem_result": "best", "cem_start": "prior"}
    expected |= {"learning_rate": 1e-3, "actor_learning_rate": 1e-3, "policy_kwargs": "net_arch=[4]", "train_freq": "1 step"}
    expected |= {"optimize_memory_usage": "False", "action_noise": "None", "diagnostics": "True"}
    assert {name: row.get(name) for name in expected} == expected
    (metrics,) = tab.metrics()
    assert metrics["eval/mean_reward"] == pytest.approx(evaluation.last_mean_reward)
    assert metrics.keys() == {"eval/mean_reward", "rollout/ep_rew_mean"}


class Middle:
    """Selects the middle of the range."""

    def select(self, score, n_states, action_dim, device="cpu"):
        return Selection(th.zeros(n_states, action_dim, device=device), th.zeros(n_states, 2, action_dim, device=device))


def test_every_argument_of_cgp_has_a_column_in_each_of_several_runs(tmp_path):
    noise = NormalActionNoise(np.zeros(1), 0.1 * np.ones(1))
    learn(tmp_path, policy_loss=None, learning_rate="lin_1e-2")
    learn(tmp_path, actor_learning_rate=1e-4, action_noise=noise, inference="cem")
    learn(tmp_path, policy_kwargs=dict(net_arch=[4], selector=Middle()), gamma=np.float32(0.5))
    first, second, third = sorted(
        Tab(tmp_path).rows(), key=lambda row: (row["policy_loss"] == "cgp", row["inference"] == "None")
    )
    columns = {info.name for info in Tab(tmp_path).experiment.hparam_infos}
    left_out = {"env", "stats_window_size", "tensorboard_log", "verbose", "_init_setup_model"}
    arguments = CGP.__init__.__code__.co_varnames[1 : CGP.__init__.__code__.co_argcount]
    assert set(arguments) - left_out <= columns
    assert first["policy_loss"] == "None"
    assert (first["learning_rate"], first["actor_learning_rate"]) == ("schedule from 0.01 to 0",) * 2
    # Numbers, although SB3 makes schedules of them
    assert (second["learning_rate"], second["actor_learning_rate"]) == (1e-3, 1e-4)
    assert (second["inference"], second["action_noise"]) == ("cem", "NormalActionNoise(mu=[0.], sigma=[0.1])")
    # Not the address of an object, which would be another one in each run
    assert (third["policy_kwargs"], third["gamma"]) == ("net_arch=[4], selector=Middle", 0.5)


@pytest.mark.parametrize("algorithm", [TD3, SAC, DDPG])
def test_other_off_policy_algorithms(algorithm, tmp_path):
    learn(tmp_path, algorithm)
    (row,) = Tab(tmp_path).rows()
    assert (row["algorithm"], row["batch_size"], row["gamma"]) == (algorithm.__name__, 8, 0.99)


def test_on_policy_algorithms(tmp_path):
    model = PPO("MlpPolicy", "Pendulum-v1", n_steps=8, batch_size=8, tensorboard_log=tmp_path, device="cpu")
    model.learn(8, HParamsCallback())
    (row,) = Tab(tmp_path).rows()
    assert (row["algorithm"], row["n_steps"], row["clip_range"], row["learning_rate"]) == ("PPO", 8, 0.2, 3e-4)


@pytest.mark.parametrize(
    ("given", "shown"),
    [
        (1e-3, 1e-3),
        (FloatSchedule(1e-3), 1e-3),
        (ConstantSchedule(1e-3), 1e-3),
        (LinearSchedule(1e-3, 1e-4, 0.5), "schedule from 0.001 to 0.0001"),
        (lambda progress_remaining: 1e-3 * progress_remaining, "schedule from 0.001 to 0"),
        # Rises and falls
        (lambda progress_remaining: 1e-3 - abs(progress_remaining - 0.5) * 1e-3, "schedule from 0.0005 to 0.0005"),
    ],
)
def test_a_schedule_is_told_from_a_number(given, shown):
    for algorithm in (CGP, TD3, SAC):
        assert hyperparameters(algorithm("MlpPolicy", "Pendulum-v1", given, **tiny()))["learning_rate"] == shown
    model = CGP("MlpPolicy", "Pendulum-v1", 1e-2, actor_learning_rate=given, **tiny())
    assert [hyperparameters(model)[name] for name in ("learning_rate", "actor_learning_rate")] == [1e-2, shown]
    clipped = PPO("MlpPolicy", "Pendulum-v1", clip_range=given, n_steps=8, batch_size=8, device="cpu")
    assert hyperparameters(clipped)["clip_range"] == shown


class PassingAll(CGP):
    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)


class PassingPositional(TD3):
    def __init__(self, *args):
        super().__init__(*args)


class WithAnother(PassingAll):
    def __init__(self, policy, env, kwargs=3, **others):
        super().__init__(policy, env, **others)
        self.kwargs = kwargs


@pytest.mark.parametrize(
    ("derived", "algorithm", "further"),
    [
        (PassingAll, CGP, {}), (PassingPositional, TD3, {}), (WithAnother, CGP, {"kwargs": 3.0}),
        (resumable(TD3), TD3, {}), (resumable(PassingAll), CGP, {}),
    ],
)  # fmt: skip
def test_arguments_that_a_subclass_passes_on_are_shown(derived, algorithm, further):
    ours, theirs = (hyperparameters(each("MlpPolicy", "Pendulum-v1")) for each in (derived, algorithm))
    assert ours == theirs | further | {"algorithm": derived.__name__}


def test_a_subclass_may_show_no_arguments():
    class Silent(CGP):
        hyperparameter_names = ()

    assert hyperparameters(Silent("MlpPolicy", "Pendulum-v1")).keys() == {"algorithm", "policy", "n_envs"}


def test_a_population_shows_its_agents_and_no_attribute_of_sb3s():
    population = Population("MlpPolicy", "Pendulum-v1", [dict(gamma=0.5), dict(gamma=0.6)], **tiny())
    shown = hyperparameters(population)
    assert shown.keys() == {"agents", "overlap", "device", "algorithm", "policy", "n_envs"}
    assert "'gamma': 0.6" in shown["agents"]


class Failing(BaseCallback):
    def _on_step(self):
        raise ZeroDivisionError


def test_a_training_that_fails_early_has_a_row(tmp_path):
    with pytest.raises(ZeroDivisionError):
        learn(tmp_path, callbacks=[Failing()])
    assert len(Tab(tmp_path).rows()) == 1


def test_metrics_are_an_argument(tmp_path):
    model = CGP("MlpPolicy", "Pendulum-v1", tensorboard_log=tmp_path, **tiny())
    model.learn(400, HParamsCallback(metrics=["train/critic_loss"]), log_interval=1)
    (metrics,) = Tab(tmp_path).metrics()
    assert metrics.keys() == {"train/critic_loss"}


def test_metrics_in_one_string_are_refused():
    with pytest.raises(ValueError, match="`metrics` is 'eval/mean_reward', but must be a sequence of keys"):
        HParamsCallback("eval/mean_reward")


def test_without_tensorboard_nothing_happens(tmp_path, capsys):
    CGP("MlpPolicy", "Pendulum-v1", verbose=1, **tiny()).learn(30, HParamsCallback())
    assert "hparams" not in capsys.readouterr().out


@pytest.mark.parametrize("given", [False, True], ids=["by itself", "with metrics of one's own"])
def test_a_run_of_rl_zoo3_fills_the_tab(given, monkeypatch, tmp_path):
    register()
    arguments = f"--algo cgp --env Pendulum-v1 --seed 3 --device cpu --num-threads 1 --log-folder {tmp_path}/logs "
    arguments += (
        f"--tensorboard-log {tmp_path}/tensorboard --eval-freq 100 --eval-episodes 1 --n-timesteps 200 --progress -params"
    )
    parameters = dict(learning_starts=20, buffer_size=100, batch_size=8, cem_samples=12, policy_kwargs="dict(net_arch=[4])")
    if given:
        parameters["callback"] = "[{'sb3_cgp.HParamsCallback': dict(metrics=['eval/mean_ep_length'])}]"
    monkeypatch.setattr(
        sys, "argv", ["train.py", *arguments.split(), *(f"{key}:{value}" for key, value in parameters.items())]
    )
    train()
    tab = Tab(tmp_path / "tensorboard")
    (row,), (metrics,) = tab.rows(), tab.metrics()
    assert (row["algorithm"], row["cem_samples"], row["seed"], row["learning_rate"]) == (
        "CGP",
        12,
        3,
        "schedule from 0.002 to 0",
    )
    if given:
        assert metrics == {"eval/mean_ep_length": 200}
    else:
        (run,) = (tmp_path / "logs" / "cgp").glob("Pendulum-v1_1")
        with np.load(run / "evaluations.npz") as evaluations:
            assert metrics["eval/mean_reward"] == pytest.approx(evaluations["results"][-1].mean())
