"""The version of the package."""

from pathlib import Path

__version__ = (Path(__file__).parent.parent / "version.txt").read_text().strip()
