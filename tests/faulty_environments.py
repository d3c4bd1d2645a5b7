"""Environments that fail at a step, alone and in processes."""

import multiprocessing
import os
import threading
import time

from environments import Doubles
from stable_baselines3.common.vec_env import SubprocVecEnv

SMALL = dict(buffer_size=200, learning_starts=10, batch_size=8, cem_samples=8, cem_elites=2, policy_kwargs=dict(net_arch=[8]))


class Failing(Doubles):
    """Calls a function at a step, and returns what it makes of the step's five values."""

    def __init__(self, fault=None, at=15, observation_space=Doubles.observation_space):
        self.fault, self.at, self.total, self.steps = fault, at, 0, 0
        self.observation_space = observation_space

    def step(self, action):
        self.total += 1
        values = super().step(action)
        return values if self.fault is None or self.total != self.at else self.fault(*values)

    def get_training_state(self):
        return {"steps": self.steps, "total": self.total, "random": self.np_random.bit_generator.state}

    def set_training_state(self, state):
        self.steps, self.total = state["steps"], state["total"]
        self.np_random.bit_generator.state = state["random"]


def raise_error(*_):
    raise ZeroDivisionError("the simulator is unstable")


def with_observation(observation):
    return lambda _, *others: (observation, *others)


def with_reward(reward):
    return lambda observation, _, *others: (observation, reward, *others)


def subproc(*faults, start_method="fork"):
    # "fork" starts in milliseconds, SB3's default in seconds
    return SubprocVecEnv([lambda fault=fault: Failing(fault) for fault in faults], start_method=start_method)


def is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def assert_buried(env):
    """No worker is left, and closing the environment neither hangs nor raises."""
    assert not any(is_running(process.pid) for process in env.processes)
    assert multiprocessing.active_children() == []
    start = time.monotonic()
    env.close()
    assert time.monotonic() - start < 1
    assert not [thread for thread in threading.enumerate() if "_run" in thread.name]
