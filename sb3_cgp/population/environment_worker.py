"""The loop of a process that steps several of a population's environments."""

import signal
from multiprocessing.connection import Connection
from typing import Any

from stable_baselines3.common.vec_env import DummyVecEnv
from stable_baselines3.common.vec_env.base_vec_env import CloudpickleWrapper

from sb3_cgp.guards.observation_fit import check_integers, check_shape


class _CheckedEnvs(DummyVecEnv):
    """
    Environments whose observations are checked before they are collected.

    NumPy rounds or broadcasts those that do not fit, so that the main process could not tell them any more.
    """

    def _save_obs(self, env_idx: int, obs: Any) -> None:
        check_shape("observation", obs, self.observation_space, None, timestep=None)
        check_integers("observation", obs, self.observation_space, timestep=None)
        super()._save_obs(env_idx, obs)


def step_chunk(remote: Connection, parent_remote: Connection, env_fns: CloudpickleWrapper) -> None:
    """
    Answer the requests of a :class:`~sb3_cgp.population.ChunkedSubprocVecEnv` about the environments of one process.

    :param remote: this process's end of the pipe
    :param parent_remote: the main process's end, which is closed here
    :param env_fns: the functions that make the environments
    """
    # Ctrl-C in a terminal reaches all processes: the main process still needs the environments to save its state, and ends
    # this one. A forked process has the main process's handler of SIGTERM.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    parent_remote.close()
    envs = _CheckedEnvs(env_fns.var)
    while True:
        try:
            command, data = remote.recv()
            if command == "step":
                remote.send((*envs.step(data), envs.reset_infos))
            elif command == "reset":
                # As `seed` and `set_options` set them; `seed` would count up from one number
                envs._seeds, envs._options = data
                remote.send((envs.reset(), envs.reset_infos))
            elif command == "call":
                method, args, kwargs = data
                remote.send(getattr(envs, method)(*args, **kwargs))
            elif command == "has_attr":
                remote.send(envs.has_attr(data))
            elif command == "get_spaces":
                remote.send((envs.observation_space, envs.action_space))
            elif command == "render":
                remote.send(envs.get_images())
            else:
                # "close"
                envs.close()
                remote.close()
                break
        except EOFError:
            break
