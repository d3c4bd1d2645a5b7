"""Fingerprints of values, by which a change of an object's attribute is noticed."""

import hashlib
import io
import pickle
from types import BuiltinFunctionType, FunctionType, MethodType, ModuleType
from typing import Any

from gymnasium import Env
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import BaseBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import BaseModel
from stable_baselines3.common.vec_env import VecEnv

# Parts of the training, which change with it, and objects without a state that could be compared
LEFT_OUT = (
    *(BaseAlgorithm, BaseModel, BaseBuffer, BaseCallback, Env, VecEnv, Logger),
    *(type, ModuleType, FunctionType, BuiltinFunctionType, MethodType, io.IOBase),
)


class _Fingerprint(pickle.Pickler):
    """Pickles into a checksum, with names in place of what is left out."""

    def __init__(self) -> None:
        self.checksum = hashlib.sha256()
        super().__init__(_Writer(self.checksum), protocol=5)

    def persistent_id(self, obj: Any) -> str | None:
        if not isinstance(obj, LEFT_OUT):
            return None
        return str(getattr(obj, "__qualname__", type(obj).__qualname__))


class _Writer:
    def __init__(self, checksum: Any):
        self.write = checksum.update


def fingerprint(value: Any) -> bytes | None:
    """
    Return a checksum of a value, with all that it refers to.

    Models, policies, replay buffers, callbacks, environments, loggers, files, functions and classes that it refers to are not
    looked into.

    :param value: the value
    :return: the checksum; None if the value cannot be pickled
    """
    pickler = _Fingerprint()
    try:
        pickler.dump(value)
    except Exception:
        # The errors are those of the value's own methods
        return None
    return pickler.checksum.digest()
