"""The description of the package on PyPI, whose links have to be absolute. All other metadata are in setup.cfg."""

from pathlib import Path

from setuptools import setup

from _build_backend import describe, link_to, repository

VERSION = Path("sb3_cgp/version.txt").read_text(encoding="utf-8").strip()
ADDRESS = repository()

setup(
    long_description=describe(Path("README.md").read_text(encoding="utf-8"), ADDRESS, VERSION),
    project_urls=link_to(ADDRESS, VERSION),
)
