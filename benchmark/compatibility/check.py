"""
A check of CGP on one environment, a script for the virtual environment that has the environment's package.

``python check.py PART FOLDER`` reads ``environment.json`` in the folder, a dictionary of the fields of
:class:`~benchmark.compatibility.package_types.Environment`, and writes ``PART.json`` there. The parts are processes of their
own: ``whole`` is a training without a stop, after which the model predicts, is saved, loaded and exported; ``stopped`` is the
same training, ended by an exception after it has saved its state; ``resumed`` continues from that state; ``learnt`` is a
longer training, which is compared with random actions.

The module imports nothing of ``benchmark``, which needs more packages than the virtual environment has.
"""

import hashlib
import json
import platform
import shutil
import sys
import time
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import torch as th
from gymnasium import spaces
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_cgp import CGP, TrainingCheckpointCallback
from sb3_cgp.resumption.environments import state_and_obstacles

# Hindsight replay needs an ended episode after the random steps, hence more than 100, the length of many. The stop is within
# an episode of 50 or 100 steps, and before the end of another.
LEARNING_STARTS, STOP, STEPS = 110, 163, 220
# Gradient steps before training is timed, and random steps, at most, in which the environment alone is
WARM_UP, ALONE = 20, 200
EPISODES = 20
DEFAULTS: dict[str, Any] = dict(seed=0, device="cpu")
REPLAY_BUFFERS = {"HerReplayBuffer": HerReplayBuffer}


class StopError(Exception):
    """Stands for what stops a training."""


class Report:
    """
    What is known of a part, written whenever more is known, so that a crash leaves what was before it.

    :param path: the file
    """

    def __init__(self, path: Path):
        self.path = path
        self.known: dict[str, Any] = {"errors": {}, "warnings": []}

    def write(self, **known: Any) -> None:
        """
        Add to what is known.

        :param known: the values by name
        """
        self.known |= known
        self.path.write_text(json.dumps(self.known, indent=2))

    @contextmanager
    def doing(self, name: str) -> Iterator[None]:
        """
        Return a context for a step of the part. Its error is noted, and ends the step.

        :param name: the step
        """
        self.write(doing=name)
        try:
            yield
        except Exception as error:
            traceback.print_exc()
            self.known["errors"][name] = f"{type(error).__name__}: {error}"
        self.write(doing=None)


class Watch(BaseCallback):
    """
    Hash the model at a step, and measure the time that training takes.

    :param stops: whether to raise :class:`StopError` at the step after
    """

    def __init__(self, stops: bool = False):
        super().__init__()
        self.stops = stops
        self.at_stop: dict[str, str] | None = None
        self.started: tuple[int, float] | None = None
        self.steps_per_second: float | None = None

    def _on_rollout_start(self) -> None:
        if self.at_stop is None and self.num_timesteps >= STOP:
            self.at_stop = fingerprint(self.model)
        if self.started is None and self.num_timesteps >= LEARNING_STARTS + WARM_UP:
            self.started = self.num_timesteps, time.process_time()

    def _on_step(self) -> bool:
        if self.stops and self.at_stop is not None:
            raise StopError
        return True

    def _on_training_end(self) -> None:
        if self.started is not None:
            steps, seconds = self.started
            self.steps_per_second = (self.num_timesteps - steps) / (time.process_time() - seconds)

    def get_training_state(self) -> dict[str, Any]:
        """
        Return no state, as a resumed training is not measured.

        :return: an empty dictionary
        """
        return {}

    def set_training_state(self, state: dict[str, Any]) -> None:
        """
        Restore nothing.

        :param state: not used
        """


def make_env(code: str) -> Any:
    """
    Make an environment.

    :param code: Python, which assigns the environment to ``env``
    :return: the environment, not seeded
    """
    names: dict[str, Any] = {}
    exec(compile(code, "environment", "exec"), names)
    return names["env"]


def make_model(environment: dict[str, Any], normalize: bool = False, **arguments: Any) -> tuple[CGP, VecEnv, spaces.Box]:
    """
    Make a model of CGP's defaults but for a short warm-up and a small replay buffer.

    :param environment: the declaration
    :param normalize: whether VecNormalize is around the environment
    :param arguments: other arguments of CGP's
    :return: the model, its environment, which it has seeded, and the space of one action
    """
    if environment["replay_buffer"] is not None:
        arguments["replay_buffer_class"] = REPLAY_BUFFERS[environment["replay_buffer"]]
    short = dict(learning_starts=LEARNING_STARTS, buffer_size=environment["buffer_size"])
    made = make_env(environment["code"])
    if normalize:
        made = VecNormalize(made, gamma=arguments["gamma"])
    model = CGP(environment["policy"], made, **(DEFAULTS | short | arguments))
    env = model.get_env()
    assert env is not None
    assert isinstance(env.action_space, spaces.Box)
    return model, env, env.action_space


def fingerprint(model: Any) -> dict[str, str]:
    """
    Hash what a training has made: networks, optimizers, replay buffer, counters.

    :param model: the model
    :return: hashes by name
    """
    found: dict[str, Any] = {f"policy.{name}": value.numpy() for name, value in model.policy.state_dict().items()}
    for name in ("actor", "critic"):
        for index, state in getattr(model, name).optimizer.state_dict()["state"].items():
            found |= {f"{name}.optimizer.{index}.{key}": np.asarray(value) for key, value in state.items()}
    buffer = model.replay_buffer
    rows = buffer.buffer_size if buffer.full else buffer.pos
    for name, value in vars(buffer).items():
        fields = value if isinstance(value, dict) else {"": value}
        arrays = {key: np.asarray(each) for key, each in fields.items() if isinstance(each, np.ndarray | th.Tensor)}
        # Rows that hold nothing yet are of memory that was not initialised; objects are infos, which hindsight replay ignores
        kept = {key: array for key, array in arrays.items() if array.ndim > 1 and array.dtype != object}
        found |= {f"replay_buffer.{name}.{key}": array[:rows] for key, array in kept.items()}
    found["counters"] = np.array([buffer.pos, buffer.full, model.num_timesteps, model._n_updates, model._episode_num])
    return {name: hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()[:16] for name, value in found.items()}


def within(actions: np.ndarray, space: spaces.Box) -> bool:
    """
    Return whether each of several actions is one that the space allows.

    :param actions: shape (B, *action)
    :param space: the space of one action
    :return: whether all of them are allowed
    """
    return all(space.contains(action.astype(space.dtype)) for action in actions)


def difference(actions: np.ndarray, expected: np.ndarray, space: spaces.Box) -> float:
    """
    Return the largest difference of actions.

    :param actions: shape (B, *action)
    :param expected: the same shape
    :param space: the space of one action
    :return: the difference in units of the width of the space
    """
    assert actions.shape == expected.shape, f"actions of shape {actions.shape}, expected {expected.shape}"
    return float(np.max(np.abs(actions - expected) / (space.high - space.low)))


def random_steps(env: VecEnv, n_steps: int) -> list[Any]:
    """
    Act at random.

    :param env: the environment
    :param n_steps: number of steps
    :return: the observations, the first one included
    """
    observations = [env.reset()]
    for _ in range(n_steps):
        observations.append(env.step(np.stack([env.action_space.sample() for _ in range(env.num_envs)]))[0])
    return observations


def whole(environment: dict[str, Any], folder: Path, report: Report) -> None:
    """
    Train without a stop, then predict, save, load and export.

    :param environment: the declaration
    :param folder: for the files
    :param report: takes the results
    """
    watch = Watch()
    with report.doing("trains"):
        model, env, space = make_model(environment)
        report.write(observations=str(env.observation_space), actions=str(space), n_envs=env.num_envs)
        model.learn(STEPS, callback=watch)
        assert model._n_updates > 0, "no gradient step was taken"
        report.write(at_stop=watch.at_stop, at_end=fingerprint(model), steps_per_second=watch.steps_per_second)
    if report.known["errors"]:
        return
    report.write(why_not_restorable=" ".join(state_and_obstacles(env)[1]) or None)
    with report.doing("steps"):
        started, steps = time.process_time(), 0
        while steps < ALONE and time.process_time() - started < 3:
            steps += (len(random_steps(env, 10)) - 1) * env.num_envs
        report.write(environment_steps_per_second=steps / (time.process_time() - started))
    with report.doing("predicts"):
        observations = random_steps(env, 5)
        expected = [model.predict(each, deterministic=True)[0] for each in observations]
        for actions in expected:
            assert within(actions, space), f"{actions} is not within {space}"
    if report.known["errors"]:
        return
    with report.doing("saves and loads"):
        model.save(folder / "model")
        loaded = CGP.load(folder / "model", env=env)
        for each, actions in zip(observations, expected, strict=True):
            np.testing.assert_array_equal(loaded.predict(each, deterministic=True)[0], actions)
    with report.doing("exports"):
        model.export(folder / "exported")
        session = onnxruntime.InferenceSession(folder / "exported" / "policy.onnx")
        without_pickle = CGP.load_weights(folder / "exported")
        largest = 0.0
        for each, actions in zip(observations, expected, strict=True):
            inputs = each if isinstance(each, dict) else {"observation": each}
            for found in (session.run(None, inputs)[0], without_pickle.predict(each)[0]):
                largest = max(largest, difference(found, actions, space))
        report.write(export_difference=largest)


def stopped(environment: dict[str, Any], folder: Path, report: Report) -> None:
    """
    Train until a state has been saved, and stop.

    :param environment: the declaration
    :param folder: for the files
    :param report: takes the results
    """
    watch = Watch(stops=True)
    shutil.rmtree(folder / "state", ignore_errors=True)
    with report.doing("stops"):
        model, _, _ = make_model(environment)
        try:
            model.learn(STEPS, callback=[TrainingCheckpointCallback(STOP, folder / "state"), watch])
        except StopError:
            report.write(at_stop=watch.at_stop)


def resumed(environment: dict[str, Any], folder: Path, report: Report) -> None:
    """
    Continue the training that :func:`stopped` has stopped.

    :param environment: the declaration
    :param folder: for the files
    :param report: takes the results
    """
    # The resumed training saves later states
    copy = folder / "resumed"
    shutil.rmtree(copy, ignore_errors=True)
    with report.doing("resumes"):
        shutil.copytree(folder / "state", copy)
        model = CGP.resume(copy, make_env(environment["code"]), device="cpu")
        model.learn(STEPS)
        assert model.num_timesteps >= STEPS, f"the training ended at step {model.num_timesteps}"
        report.write(at_end=fingerprint(model))


def learnt(environment: dict[str, Any], folder: Path, report: Report) -> None:
    """
    Train for the declared number of steps, and compare the actor's returns with those of random actions.

    :param environment: the declaration
    :param folder: unused
    :param report: takes the results
    """
    learning = environment["learning"]
    with report.doing("learns"):
        model, env, _ = make_model(environment, learning["normalize"], **learning["arguments"])
        started = time.process_time()
        model.learn(learning["steps"])
        report.write(learning_seconds=time.process_time() - started)
        if isinstance(env, VecNormalize):
            env.training = env.norm_reward = False
        actor, actor_successes = returns(model, env)
        random, random_successes = returns(RandomActions(env), env)
        report.write(returns=actor, random_returns=random, successes=actor_successes, random_successes=random_successes)


class RandomActions:
    """
    A policy that acts at random.

    :param env: the environment
    """

    def __init__(self, env: VecEnv):
        self.env = env

    def predict(self, *args: Any, **kwargs: Any) -> tuple[np.ndarray, None]:
        """
        Draw an action for each environment.

        :param args: ignored
        :param kwargs: ignored
        :return: the actions, and no state
        """
        return np.stack([self.env.action_space.sample() for _ in range(self.env.num_envs)]), None


def returns(policy: Any, env: VecEnv) -> tuple[list[float], int | None]:
    """
    Evaluate a policy.

    :param policy: the policy
    :param env: the environment
    :return: the returns of the episodes, and how many ended in success, or None where the environment does not say
    """
    successes: list[bool] = []

    def note(names: dict[str, Any], _: dict[str, Any]) -> None:
        if names["done"] and "is_success" in names["info"]:
            successes.append(bool(names["info"]["is_success"]))

    found, _ = evaluate_policy(policy, env, EPISODES, return_episode_rewards=True, callback=note, warn=False)
    assert isinstance(found, list)
    return [float(each) for each in found], sum(successes) if successes else None


def main() -> None:
    """Carry out a part, and write what was found."""
    part, folder = sys.argv[1], Path(sys.argv[2])
    th.set_num_threads(1)
    environment = json.loads((folder / "environment.json").read_text())
    report = Report(folder / f"{part}.json")
    versions = {each.metadata["Name"].lower().replace("_", "-"): each.version for each in metadata.distributions()}
    report.write(versions=versions, python=platform.python_version())
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        {"whole": whole, "stopped": stopped, "resumed": resumed, "learnt": learnt}[part](environment, folder, report)
    messages = dict.fromkeys(str(each.message) for each in caught if each.category is UserWarning)
    report.write(warnings=list(messages), doing=None, complete=True)


if __name__ == "__main__":
    main()
