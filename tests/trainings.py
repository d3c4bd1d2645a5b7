"""Trainings that are stopped, and go on, for the tests of resumption."""

import random
from pathlib import Path

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.vec_env import VecNormalize

from sb3_cgp import CGP
from sb3_cgp.resumption import TrainingCheckpointCallback

SMALL = dict(learning_starts=20, buffer_size=150, batch_size=8, cem_samples=8, cem_elites=2, seed=0, device="cpu")


def make_model(**arguments):
    """Make a small model on Pendulum-v1."""
    arguments = dict(env=make_vec_env("Pendulum-v1", seed=1), policy_kwargs=dict(net_arch=[8])) | SMALL | arguments
    return CGP("MlpPolicy", **arguments)


def parameters_equal(one, other):
    pairs = zip(one.policy.state_dict().values(), other.policy.state_dict().values(), strict=True)
    return all(ours.equal(theirs) for ours, theirs in pairs)


class Interruption(Exception):
    """Whatever may end a training."""


class Do(BaseCallback):
    """Calls a function at a step, of the environment or, offline, of the policy's training."""

    def __init__(self, step, function):
        super().__init__()
        self.step, self.function = step, function

    def _on_step(self):
        if self.n_calls == self.step:
            self.function()
        return True


class Stop(BaseCallback):
    """
    Interrupts the training. On the way it draws from Python's generator, and logs the mean since it was last written.

    :param step: at which environment step; None for never
    """

    def __init__(self, step):
        super().__init__()
        self.step = step

    def _on_step(self):
        self.logger.record_mean("random/mean", random.random())
        if self.step is not None and self.num_timesteps >= self.step:
            raise Interruption
        return True


class Written(KVWriter):
    """Keeps what a logger writes, by step, but for times."""

    def __init__(self):
        self.lines = {}

    def write(self, key_values, key_excluded, step=0):
        self.lines[step] = {key: value for key, value in key_values.items() if not key.startswith("time/")}

    def close(self):
        pass


class Training:
    """
    A training that may be stopped and resumed any number of times.

    :param folder: for states and evaluations
    :param env: the environment's name or class
    :param n_envs: number of environments
    :param normalises: whether VecNormalize is around them
    :param steps: the training's length
    :param save_freq: steps between two states
    :param eval_freq: steps between two evaluations
    :param arguments: CGP's arguments
    """

    def __init__(
        self, folder, env="Pendulum-v1", n_envs=1, normalises=False, steps=120, save_freq=10, eval_freq=35, **arguments
    ):
        self.folder, self.env, self.n_envs, self.normalises = Path(folder), env, n_envs, normalises
        self.steps, self.save_freq, self.eval_freq, self.arguments = steps, save_freq, eval_freq, arguments
        self.written = Written()

    def make_env(self, seed, trains=True):
        env = make_vec_env(self.env, n_envs=self.n_envs if trains else 1, seed=seed)
        return VecNormalize(env, training=trains) if self.normalises else env

    def make_model(self):
        arguments = dict(policy="MlpPolicy", env=self.make_env(seed=1), policy_kwargs=dict(net_arch=[8, 8]))
        return CGP(**(SMALL | arguments | self.arguments))

    def run(self, *stops):
        """Train, stop at the given steps, each time with another process's random numbers, and return the model."""
        model = self.make_model()
        for stop in stops:
            try:
                self.learn(model, stop)
                return model
            except Interruption:
                for seed_all in (random.seed, np.random.seed, th.manual_seed):
                    seed_all(stop)
                model = CGP.resume(self.folder / "state", self.make_env(seed=100 + stop))
        return self.learn(model, None)

    def learn(self, model, stop, *callbacks):
        model.set_logger(Logger(None, [self.written]))
        checkpoint = TrainingCheckpointCallback(self.save_freq, self.folder / "state")
        self.evaluation = EvalCallback(
            self.make_env(seed=2 if model.resumption is None else 200, trains=False),
            n_eval_episodes=1,
            eval_freq=max(self.eval_freq // self.n_envs, 1),
            log_path=str(self.folder),
            verbose=0,
        )
        return model.learn(self.steps, callback=[checkpoint, self.evaluation, Stop(stop), *callbacks], log_interval=1)


def fingerprint(training, model):
    """All that a training has made and all that it would go on with, as arrays by name."""
    found = {name: tensor.numpy(force=True) for name, tensor in model.policy.state_dict().items()}
    for name, optimizer in (("actor", model.actor.optimizer), ("critic", model.critic.optimizer)):
        for index, state in optimizer.state_dict()["state"].items():
            found |= {f"{name}.{index}.{key}": value.numpy(force=True) for key, value in state.items()}
    buffer = model.replay_buffer
    for name in ("observations", "next_observations", "actions", "rewards", "dones", "timeouts"):
        value = getattr(buffer, name, None)
        fields = value if isinstance(value, dict) else {name: value}
        found |= {f"{name}.{key}": th.as_tensor(field).numpy(force=True) for key, field in fields.items() if field is not None}
    found["position"] = np.array([buffer.pos, buffer.full, model.num_timesteps, model._n_updates, model._episode_num])
    found["numpy"] = np.random.get_state()[1]  # noqa: NPY002
    found["torch"] = th.get_rng_state().numpy()
    found |= {
        f"cuda {gpu}": state.numpy()
        for gpu, state in enumerate(th.cuda.get_rng_state_all() if model.device.type == "cuda" else [])
    }
    found["python"] = np.array(random.getstate()[1], dtype=np.uint64)
    found["evaluations"] = np.array(training.evaluation.evaluations_results)
    found["evaluated at"] = np.array(training.evaluation.evaluations_timesteps)
    found["best"] = np.array(training.evaluation.best_mean_reward)
    if model.get_vec_normalize_env() is not None:
        normalizer = model.get_vec_normalize_env()
        statistics = normalizer.obs_rms if isinstance(normalizer.obs_rms, dict) else {"": normalizer.obs_rms}
        found |= {f"mean.{key}": each.mean for key, each in statistics.items()}
        found |= {"var": normalizer.ret_rms.var, "returns": normalizer.returns}
    return found


def assert_same(found, expected):
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        np.testing.assert_array_equal(found[name], value, err_msg=name, strict=True)


def interrupted(folder, stop=47, **case):
    """Train until the stop."""
    training = Training(folder, **case)
    with pytest.raises(Interruption):
        training.learn(training.make_model(), stop)
    return training
