"""Packages that only an extra of sb3-cgp installs."""

import importlib
import importlib.util
from types import ModuleType

from sb3_cgp.common.version import __version__


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
        raise _not_installed(error.name, extra, purpose) from error


def require_from_extra(name: str, extra: str, purpose: str) -> None:
    """
    Check that a package is installed, without importing it.

    :param name: name of the package
    :param extra: name of the extra that installs the package
    :param purpose: what needs the package; it begins the error's sentence
    :raises ImportError: if the package is not installed; it names the extra
    """
    if importlib.util.find_spec(name) is None:
        raise _not_installed(name, extra, purpose)


def how_to_install(extra: str) -> str:
    """
    Return the commands that install an extra. None of them needs a package index that has sb3-cgp.

    :param extra: name of the extra
    :return: the commands for a clone, and for a wheel
    """
    clone = f'pip install -c constraints.txt -e ".[{extra}]"'
    wheel = f'pip install "sb3_cgp-{__version__}-py3-none-any.whl[{extra}]"'
    return f"in a clone, {clone}; with the wheel of sb3-cgp, {wheel}"


def _not_installed(name: str | None, extra: str, purpose: str) -> ImportError:
    return ImportError(
        f"{purpose} needs {name}, which is not installed. It is in the extra `{extra}`: {how_to_install(extra)}"
    )
