"""The build backend: setuptools', plus the files that setuptools has no way to put into a wheel.

Every wheel, an editable one too, gets the start-up hook ``_sb3_cgp_zoo`` and the two lines that start it with Python:
setuptools installs neither ``.pth`` nor ``.start`` files, and hooking its commands instead would need its private classes.
The hook itself is copied for an editable install too: it is compiled then, and it survives a checkout that is moved away.
A regular wheel also gets ``hyperparams/``, which lies outside the package; an editable install reads it where it is.
"""

import base64
import csv
import hashlib
import io
import os
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
# A .pth line is executed as one line, hence exec; guarded, because a hook that is gone or broken must not print at every
# start. Python 3.15 and later ignore the line where a .start file of the same name exists (PEP 829).
STARTUP_LINES = {
    "sb3_cgp.pth": r'import sys; exec("try:\n import _sb3_cgp_zoo\n _sb3_cgp_zoo.install()\nexcept Exception:\n pass")' "\n",
    "sb3_cgp.start": "_sb3_cgp_zoo:install\n",
}


def build_wheel(wheel_directory: str, config_settings: Any = None, metadata_directory: str | None = None) -> str:
    """
    Build the wheel that ``pip install .`` installs (PEP 517).

    :param wheel_directory: where to put it
    :param config_settings: the front end's settings, for setuptools
    :param metadata_directory: metadata that was prepared before, if any
    :return: the wheel's file name
    """
    name = build_meta.build_wheel(wheel_directory, config_settings, metadata_directory)
    add_files(Path(wheel_directory, name), startup_files() | hyperparams())
    return name


def build_editable(wheel_directory: str, config_settings: Any = None, metadata_directory: str | None = None) -> str:
    """
    Build the wheel that ``pip install -e .`` installs (PEP 660).

    :param wheel_directory: where to put it
    :param config_settings: the front end's settings, for setuptools
    :param metadata_directory: metadata that was prepared before, if any
    :return: the wheel's file name
    """
    name = build_meta.build_editable(wheel_directory, config_settings, metadata_directory)
    add_files(Path(wheel_directory, name), startup_files())
    return name


def startup_files() -> dict[str, str]:
    """
    Read what goes to the top level of site-packages. Front ends run build hooks in the source tree's root.

    :return: contents by path inside the wheel
    """
    return STARTUP_LINES | {HOOK: Path(HOOK).read_text(encoding="utf-8")}


def hyperparams() -> dict[str, str]:
    """
    Read the YAML files that travel inside the package.

    :return: contents by path inside the wheel
    """
    files = Path("hyperparams").rglob("*.yml")
    return {f"sb3_cgp/{file.as_posix()}": file.read_text(encoding="utf-8") for file in files}


def add_files(wheel: Path, files: Mapping[str, str]) -> None:
    """
    Add text files to a wheel, and to its RECORD: what is recorded there is also uninstalled.

    :param wheel: the wheel, rewritten in place
    :param files: contents by path inside the wheel
    """
    with zipfile.ZipFile(wheel) as archive:
        members = {member: archive.read(member) for member in archive.infolist()}
    (record,) = (member for member in members if member.filename.endswith(".dist-info/RECORD"))

    rows = io.StringIO()
    writer = csv.writer(rows, lineterminator="\n")
    for path, text in sorted(files.items()):
        content = text.encode()
        # RECORD's date is the build's, or SOURCE_DATE_EPOCH: builds stay reproducible.
        member = zipfile.ZipInfo(path, date_time=record.date_time)
        member.external_attr = record.external_attr
        members[member] = content
        digest = base64.urlsafe_b64encode(hashlib.sha256(content).digest()).rstrip(b"=").decode()
        writer.writerow([path, f"sha256={digest}", len(content)])
    # Last in the archive, as the wheel format recommends.
    members[record] = rows.getvalue().encode() + members.pop(record)

    rewritten = wheel.with_suffix(".tmp")
    with zipfile.ZipFile(rewritten, "w", compression=zipfile.ZIP_DEFLATED) as archive:
        for member, content in members.items():
            archive.writestr(member, content, compress_type=zipfile.ZIP_DEFLATED)
    os.replace(rewritten, wheel)
