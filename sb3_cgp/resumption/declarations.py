"""Which classes of environments and wrappers are restorable, and how: by their own methods, by declaration, or ready."""

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any, NamedTuple

import cloudpickle

from sb3_cgp.common.rules import require

METHODS = "get_training_state() and set_training_state()"


class Obstacle(NamedTuple):
    """
    Why the state of an environment cannot be saved.

    :param text: a sentence, with what would help
    :param prevents_restoring: False if an earlier state can be restored all the same
    """

    text: str
    prevents_restoring: bool = True


@dataclass(frozen=True)
class Declaration:
    """
    How the objects of a class are saved and restored.

    :param get: returns an object's state as plain data, or None if it cannot be restored now. Without this function, the
        state is the object's attributes.
    :param set: restores that state
    :param described: the name of ``get`` in messages, following the name of the class
    """

    get: Callable[[Any], Any] | None
    set: Callable[[Any, Any], Any] | None
    described: str


# By the methods of the class
OWN = Declaration(
    lambda layer: layer.get_training_state(), lambda layer, state: layer.set_training_state(state), ".get_training_state()"
)
ATTRIBUTES = Declaration(None, None, "")
# Classes of packages that need not be installed, by their full names: the module of the functions `get_state` and `set_state`,
# or None where the attributes are the state, with MuJoCo's data and model, which are saved for every environment
READY: dict[str, str | None] = {
    "gymnasium.envs.mujoco.mujoco_env.MujocoEnv": None,
    "gymnasium_robotics.envs.robot_env.MujocoRobotEnv": None,
    "shimmy.dm_control_compatibility.DmControlCompatibilityV0": "sb3_cgp.resumption.dm_control",
}
_declared: dict[type, Declaration] = {}
# Those of the training's process in a worker, by the class's full name there: in a worker that was forked, a class of a script
# is another object than the one that cloudpickle makes; in others, its name is another
_received: dict[str, Declaration] = {}
DESCRIBED = ": the function `get` that register_restorable was given"


def register_restorable(
    cls: type, get: Callable[[Any], Any] | None = None, set: Callable[[Any, Any], Any] | None = None
) -> None:
    """
    Declare that a class of environments or wrappers is restorable, without changing the class.

    The declaration holds for subclasses, unless they have one of their own or the method ``get_training_state``. It belongs to
    this process, and is sent to the workers of a ``SubprocVecEnv``, however these were started, when a state is saved or
    restored. Call it before ``learn``, in each process that trains or resumes.

    :param cls: the class
    :param get: a function of an object of the class, which returns its state as plain data, or None if it cannot be restored
        now: without what the object wraps, ``np_random``, the random generators of its spaces, and MuJoCo's data and model in
        its attribute ``data``, which are saved anyway. None: the object's attributes are its state, all of them plain data.
    :param set: a function of an object and that state, which restores it; None as ``get`` is. It may be called before the
        first ``reset``.
    :raises ValueError: if ``cls`` is not a class, or ``get`` and ``set`` are neither both functions nor both None
    """
    require(isinstance(cls, type), "cls", cls, "a class of environments or wrappers")
    for name, function in (("get", get), ("set", set)):
        require(function is None or callable(function), name, function, "a function, or None")
    require((get is None) == (set is None), "set", set, "a function where `get` is one, and None where `get` is None")
    _declared[cls] = Declaration(get, set, DESCRIBED)


def full_name(cls: type) -> str:
    """
    Return the name of a class with its module.

    :param cls: the class
    :return: the name
    """
    return f"{cls.__module__}.{cls.__qualname__}"


def find_declaration(kind: type) -> Declaration | None:
    """
    Return how the objects of a class are saved, by the first of its base classes that says so.

    :param kind: the class
    :return: the declaration, or None
    """
    for base in kind.__mro__:
        name = full_name(base)
        if name in _received:
            return _received[name]
        if base in _declared:
            return _declared[base]
        if "get_training_state" in vars(base):
            return OWN
        if name in READY:
            module = READY[name]
            return ATTRIBUTES if module is None else _ready(module)
    return None


def pickle_declarations(problems: list[Obstacle]) -> list[bytes]:
    """
    Return what :func:`register_restorable` was given in this process, to be sent to workers.

    :param problems: a list to which an obstacle is appended for each declaration that cannot be sent
    :return: the declarations
    """
    pickled = []
    for cls, declaration in _declared.items():
        try:
            # By cloudpickle, as SubprocVecEnv sends environments: it takes functions of scripts, too
            pickled.append(cloudpickle.dumps((cls, full_name(cls), declaration.get, declaration.set)))
        except Exception as error:
            remedy = "give register_restorable functions of a module"
            text = f"What {cls.__qualname__} was declared with cannot be sent to a process ({error}): {remedy}."
            problems.append(Obstacle(text))
    return pickled


def unpickle_declarations(pickled: list[bytes]) -> None:
    """
    Repeat in a worker what :func:`register_restorable` was given in the training's process.

    :param pickled: what :func:`pickle_declarations` returned
    """
    for cls, name, get, set_function in map(cloudpickle.loads, pickled):
        _declared[cls] = _received[name] = Declaration(get, set_function, DESCRIBED)


def _ready(module: str) -> Declaration:
    functions = import_module(module)
    return Declaration(functions.get_state, functions.set_state, f": {module}.get_state()")
