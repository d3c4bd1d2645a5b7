"""
Check that a tag can be released, before anything is uploaded: a version on PyPI cannot be replaced.

`python .github/check_release.py v1.2.3` prints what is missing, and exits with status 1 if anything is.
"""

import argparse
import configparser
import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]


def find_faults(root: Path, tag: str, address: str | None = None) -> Iterator[str]:
    """
    Yield a line for every reason not to release.

    :param root: the folder of the repository
    :param tag: the tag's name
    :param address: the address of the repository in which the tag was set; None to compare with none
    """
    version = (root / "sb3_cgp" / "version.txt").read_text(encoding="utf-8").strip()
    if tag != f"v{version}":
        yield f"the tag is {tag!r}, and sb3_cgp/version.txt has {version}, whose tag is 'v{version}'"
    changelog = (root / "CHANGELOG.md").read_text(encoding="utf-8")
    if not re.search(rf"^## \[?{re.escape(version)}\]? - \d{{4}}-\d\d-\d\d$", changelog, flags=re.MULTILINE):
        yield f"CHANGELOG.md has no heading '## [{version}] - ' with the date of the release"
    settings = configparser.ConfigParser()
    settings.read(root / "setup.cfg", encoding="utf-8")
    stated = settings.get("repository", "address", fallback="").strip().rstrip("/")
    if not stated:
        yield "[repository] in setup.cfg has no address: README's links would not work on PyPI"
    elif address is not None and stated.lower() != address.rstrip("/").lower():
        yield f"the address in [repository] of setup.cfg is {stated}, and the tag was set in {address}"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tag")
    parser.add_argument("--address")
    options = parser.parse_args()
    faults = list(find_faults(ROOT, options.tag, options.address))
    print("".join(f"{fault}\n" for fault in faults), end="")
    sys.exit(bool(faults))
