"""Imports of packages that only an extra of sb3-cgp installs."""

import importlib
from types import ModuleType


def import_from_extra(name: str, extra: str, purpose: str) -> ModuleType:
    """
    Import a module of a package that an extra installs.

    :param name: full name of the module
    :param extra: name of the extra
    :param purpose: what needs the package; it begins the error's sentence
    :return: the module
    :raises ImportError: if the module, or a module that it imports, is not installed; it names the extra
    """
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        raise ImportError(
            f'{purpose} needs {error.name}, which is not installed: pip install "sb3-cgp[{extra}]" '
            f'(in a clone: pip install -e ".[{extra}]")'
        ) from error
