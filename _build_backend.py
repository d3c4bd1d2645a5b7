"""The build backend: that of setuptools, with additional files in the wheel, and with a description for PyPI.

Every wheel, also that of an editable install, contains the start-up hook ``_sb3_cgp_zoo`` and the two files that call it at
the start of Python. setuptools installs neither ``.pth`` nor ``.start`` files, and its commands could be extended only by
their private classes. An editable install contains a copy of the hook, too: the copy is compiled, and it remains if the
checkout is moved. A regular wheel also contains ``hyperparams/``, which an editable install reads from the checkout.

``setup.py`` takes the description from here: README's links to files of the repository do not work on PyPI.
"""

import base64
import configparser
import csv
import hashlib
import io
import os
import re
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from setuptools import build_meta
from setuptools.build_meta import (
    build_sdist,
    get_requires_for_build_editable,
    get_requires_for_build_sdist,
    get_requires_for_build_wheel,
    prepare_metadata_for_build_editable,
    prepare_metadata_for_build_wheel,
)

__all__ = [
    "build_editable",
    "build_sdist",
    "build_wheel",
    "get_requires_for_build_editable",
    "get_requires_for_build_sdist",
    "get_requires_for_build_wheel",
    "prepare_metadata_for_build_editable",
    "prepare_metadata_for_build_wheel",
]

HOOK = "_sb3_cgp_zoo.py"
# A .pth file holds single lines, hence exec. Errors are ignored, because a missing or broken hook must not print at every
# start of Python. Python 3.15 and later ignore a .pth file beside a .start file of the same name (PEP 829).
STARTUP_LINES = {
    "sb3_cgp.pth": r'import sys; exec("try:\n import _sb3_cgp_zoo\n _sb3_cgp_zoo.install()\nexcept Exception:\n pass")' "\n",
    "sb3_cgp.start": "_sb3_cgp_zoo:install\n",
}

# Code, in which brackets are no links
CODE = re.compile(r"(```.*?```|`[^`\n]*`)", re.DOTALL)
# The targets of links and images that are relative, in Markdown and in HTML; "#part" is within the page.
RELATIVE = re.compile(
    r"""(?P<before>\]\(|^\[[^\]]+\]:\s+|\b(?:src|srcset|href)=")(?!\#|//|[a-z][a-z\d+.-]*:)(?P<path>[^\s)"]+)""",
    re.IGNORECASE | re.MULTILINE,
)
PICTURES = (".gif", ".jpg", ".jpeg", ".png", ".svg", ".webp")


def build_wheel(wheel_directory: str, config_settings: Any = None, metadata_directory: str | None = None) -> str:
    """
    Build the wheel that ``pip install .`` installs (PEP 517).

    :param wheel_directory: the folder for the wheel
    :param config_settings: the settings of the build front end, for setuptools
    :param metadata_directory: the folder with prepared metadata, None for none
    :return: the wheel's file name
    """
    name = build_meta.build_wheel(wheel_directory, config_settings, metadata_directory)
    add_files(Path(wheel_directory, name), startup_files() | hyperparams())
    return name


def build_editable(wheel_directory: str, config_settings: Any = None, metadata_directory: str | None = None) -> str:
    """
    Build the wheel that ``pip install -e .`` installs (PEP 660).

    :param wheel_directory: the folder for the wheel
    :param config_settings: the settings of the build front end, for setuptools
    :param metadata_directory: the folder with prepared metadata, None for none
    :return: the wheel's file name
    """
    name = build_meta.build_editable(wheel_directory, config_settings, metadata_directory)
    add_files(Path(wheel_directory, name), startup_files())
    return name


def startup_files() -> dict[str, str]:
    """
    Return the files for the top level of site-packages. The working directory is the root of the source tree (PEP 517).

    :return: contents by path inside the wheel
    """
    return STARTUP_LINES | {HOOK: Path(HOOK).read_text(encoding="utf-8")}


def hyperparams() -> dict[str, str]:
    """
    Return the YAML files that the package contains in a wheel.

    :return: contents by path inside the wheel
    """
    files = Path("hyperparams").rglob("*.yml")
    return {f"sb3_cgp/{file.as_posix()}": file.read_text(encoding="utf-8") for file in files}


def add_files(wheel: Path, files: Mapping[str, str]) -> None:
    """
    Add text files to a wheel, and to its RECORD, from which an installer uninstalls.

    :param wheel: the wheel, which is replaced
    :param files: contents by path inside the wheel
    """
    with zipfile.ZipFile(wheel) as archive:
        members = {member: archive.read(member) for member in archive.infolist()}
    (record,) = (member for member in members if member.filename.endswith(".dist-info/RECORD"))

    rows = io.StringIO()
    writer = csv.writer(rows, lineterminator="\n")
    for path, text in sorted(files.items()):
        content = text.encode()
        # The date of RECORD is that of the build or SOURCE_DATE_EPOCH, so that builds are reproducible.
        member = zipfile.ZipInfo(path, date_time=record.date_time)
        member.external_attr = record.external_attr
        members[member] = content
        digest = base64.urlsafe_b64encode(hashlib.sha256(content).digest()).rstrip(b"=").decode()
        writer.writerow([path, f"sha256={digest}", len(content)])
    # The wheel format recommends RECORD as the last file of the archive.
    members[record] = rows.getvalue().encode() + members.pop(record)

    rewritten = wheel.with_suffix(".tmp")
    with zipfile.ZipFile(rewritten, "w", compression=zipfile.ZIP_DEFLATED) as archive:
        for member, content in members.items():
            archive.writestr(member, content, compress_type=zipfile.ZIP_DEFLATED)
    os.replace(rewritten, wheel)


def repository() -> str:
    """
    Return the address of the repository from ``setup.cfg``, without a slash at its end.

    :return: the address, empty if none is set
    """
    settings = configparser.ConfigParser()
    settings.read("setup.cfg", encoding="utf-8")
    return settings.get("repository", "address", fallback="").strip().rstrip("/")


def describe(readme: str, address: str, version: str) -> str:
    """
    Return the description for PyPI: README, with relative links made absolute, to the files of the version's tag.

    :param readme: the text of README.md
    :param address: the address of the repository; README is returned unchanged if it is empty
    :param version: the version, whose tag is ``v`` and the version
    :return: the description, in Markdown
    """

    def absolute(found: re.Match[str]) -> str:
        kind = "raw" if found["path"].partition("#")[0].lower().endswith(PICTURES) else "blob"
        return f"{found['before']}{address}/{kind}/v{version}/{found['path'].removeprefix('./')}"

    if not address:
        return readme
    # Parts at odd places are code
    parts = CODE.split(readme)
    parts[::2] = [RELATIVE.sub(absolute, part) for part in parts[::2]]
    return "".join(parts)


def link_to(address: str, version: str) -> dict[str, str]:
    """
    Return the links that PyPI shows beside the description.

    :param address: the address of the repository, empty if none is set
    :param version: the version, whose tag is ``v`` and the version
    :return: addresses by name, none if the repository has no address
    """
    if not address:
        return {}
    return {
        "Source": address,
        "Documentation": f"{address}/blob/v{version}/docs/index.md",
        "Changelog": f"{address}/blob/v{version}/CHANGELOG.md",
        "Questions and bugs": f"{address}/issues",
    }
