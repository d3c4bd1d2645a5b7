"""Lets rl_zoo3 know CGP, whichever of its scripts is run, from wherever.

Why this exists: rl_zoo3 has no plug-in mechanism. ``python -m rl_zoo3.train --algo cgp`` runs no code of ours unless some
of it runs with every start of Python, so ``sb3_cgp.pth`` (from Python 3.15 on ``sb3_cgp.start``) calls :func:`install`.
That only puts one finder on ``sys.meta_path``. When rl_zoo3 has executed one of three of its modules, and not before,
:mod:`sb3_cgp.zoo.registration` is imported and adds CGP to it.

Why a module of its own: it must import nothing, and whatever is inside ``sb3_cgp`` imports PyTorch.
"""

import sys

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Sequence
    from importlib.machinery import ModuleSpec
    from types import ModuleType
    from typing import Any

# The function of sb3_cgp.zoo.registration to call when rl_zoo3 has executed the module.
_FUNCTIONS = {
    "rl_zoo3.utils": "register_algorithm",
    "rl_zoo3.hyperparams_opt": "register_search_space",
    "rl_zoo3.exp_manager": "register_default_config",
}


class _Finder:
    """Finds rl_zoo3's modules as the other finders do, and sees to it that registration follows their execution."""

    def __init__(self) -> None:
        self._searching: set[str] = set()

    def find_spec(
        self, name: str, path: "Sequence[str] | None" = None, target: "ModuleType | None" = None
    ) -> "ModuleSpec | None":
        """
        Find a module (the interface of ``sys.meta_path``).

        :param name: full name of the module
        :param path: the parent package's ``__path__``
        :param target: the module to be reloaded, if it is one
        :return: where the module is, None to leave it to the other finders
        """
        # Another finder that asks the whole of sys.meta_path, as this one does, would come back here without end.
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
    :param loader: the loader of the module; it keeps its class and all its other methods
    :param name: full name of the module
    """
    execute = loader.exec_module

    def exec_module(module: "ModuleType") -> None:
        execute(module)
        # Some loaders, zipimport's for one, load several modules.
        if module.__name__ == name:
            _register(_FUNCTIONS[name])

    loader.exec_module = exec_module


def _register(function: str) -> None:
    """
    :param function: name of the function of :mod:`sb3_cgp.zoo.registration` to call
    """
    try:
        from sb3_cgp.zoo import registration as zoo

        getattr(zoo, function)()
    except Exception as error:
        _give_up(error)


def _give_up(error: Exception) -> None:
    """
    Leave rl_zoo3 alone from now on, so that it works on without CGP, and say so once.

    :param error: what went wrong
    """
    import warnings

    sys.meta_path[:] = [finder for finder in sys.meta_path if not isinstance(finder, _Finder)]
    warnings.warn(
        "sb3_cgp is installed but could not register itself in rl_zoo3, which goes on without the algorithm `cgp`: "
        f"{type(error).__name__}: {error}",
        RuntimeWarning,
        stacklevel=2,
    )


def install() -> None:
    """Have CGP registered in rl_zoo3 as soon as that is imported."""
    if not any(isinstance(finder, _Finder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Finder())
