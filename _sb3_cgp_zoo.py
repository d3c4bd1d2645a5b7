"""Registration of CGP in rl_zoo3 when that is imported, by any of its scripts and from any folder.

rl_zoo3 has no plug-in mechanism, and ``python -m rl_zoo3.train --algo cgp`` executes no code of sb3_cgp. Therefore
``sb3_cgp.pth`` (from Python 3.15 on, ``sb3_cgp.start``) calls :func:`install` at every start of Python. It adds a finder to
``sys.meta_path``, and imports nothing. After rl_zoo3 has executed one of the three modules in ``_FUNCTIONS``, the finder
imports :mod:`sb3_cgp.zoo.registration`, which adds CGP to that module. Without rl_zoo3, nothing else happens.

This module is outside of the package, because importing ``sb3_cgp`` imports PyTorch.
"""

import sys

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Sequence
    from importlib.machinery import ModuleSpec
    from types import ModuleType
    from typing import Any

# For each module of rl_zoo3, the function of sb3_cgp.zoo.registration to call after the module's execution
_FUNCTIONS = {
    "rl_zoo3.utils": "register_algorithm",
    "rl_zoo3.hyperparams_opt": "register_search_space",
    "rl_zoo3.exp_manager": "register_default_config",
}


class _Finder:
    """Finds rl_zoo3's modules by the other finders, and has CGP registered after their execution."""

    def __init__(self) -> None:
        self._searching: set[str] = set()

    def find_spec(
        self, name: str, path: "Sequence[str] | None" = None, target: "ModuleType | None" = None
    ) -> "ModuleSpec | None":
        """
        Find a module (the interface of ``sys.meta_path``).

        :param name: full name of the module
        :param path: the parent package's ``__path__``
        :param target: the module that is reloaded, None if the module is imported for the first time
        :return: the specification of the module, or None for modules of no interest and where the other finders fail
        """
        # A second finder that calls all of sys.meta_path, as this one does, would otherwise cause an endless recursion.
        if name not in _FUNCTIONS or name in self._searching:
            return None
        self._searching.add(name)
        try:
            for finder in sys.meta_path:
                spec = finder.find_spec(name, path, target)
                if spec is not None:
                    _register_after_execution(spec.loader, name)
                    return spec
        except Exception as error:
            _give_up(error)
        finally:
            self._searching.discard(name)
        return None


def _register_after_execution(loader: "Any", name: str) -> None:
    """
    Have CGP registered after a loader has executed a module.

    :param loader: the loader of the module; it keeps its class and its other methods
    :param name: full name of the module
    """
    execute = loader.exec_module

    def exec_module(module: "ModuleType") -> None:
        execute(module)
        # Some loaders, such as zipimport's, load several modules.
        if module.__name__ == name:
            _register(_FUNCTIONS[name])

    loader.exec_module = exec_module


def _register(function: str) -> None:
    """
    Call a function that registers CGP.

    :param function: name of the function of :mod:`sb3_cgp.zoo.registration` to call
    """
    try:
        from sb3_cgp.zoo import registration as zoo

        getattr(zoo, function)()
    except Exception as error:
        _give_up(error)


def _give_up(error: Exception) -> None:
    """
    Remove the finder, so that rl_zoo3 works without CGP, and warn once.

    :param error: the error of the registration
    """
    import warnings

    sys.meta_path[:] = [finder for finder in sys.meta_path if not isinstance(finder, _Finder)]
    warnings.warn(
        "sb3_cgp is installed but could not register itself in rl_zoo3, which continues without the algorithm `cgp`: "
        f"{type(error).__name__}: {error}",
        RuntimeWarning,
        stacklevel=2,
    )


def install() -> None:
    """Add the finder to ``sys.meta_path``, unless it is there already."""
    if not any(isinstance(finder, _Finder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Finder())
