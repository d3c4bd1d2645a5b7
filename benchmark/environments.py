"""
Test CGP on environments of other packages, each installed from PyPI into a virtual environment of its own.

``python -m benchmark.environments`` writes a record for each package, and a page with the table of all.
"""

import argparse
import os
import shutil
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch as th
from packaging.utils import canonicalize_name

from benchmark.common.arguments import add_epilog, count, output_folder
from benchmark.common.files import read_json, write_json
from benchmark.common.provenance import commit, machine
from benchmark.compatibility.checking import check
from benchmark.compatibility.installing import install, read_pins
from benchmark.compatibility.package_types import Package
from benchmark.compatibility.packages import PACKAGES
from benchmark.compatibility.page import page
from sb3_cgp.common.files import write_atomically

PROJECT = Path(__file__).parent.parent


def parse(argv: Sequence[str]) -> argparse.Namespace:
    """
    Read the command line.

    :param argv: the arguments
    :return: the parsed arguments
    """
    description = "Test CGP on the environments of other packages."
    parser = argparse.ArgumentParser(prog="python -m benchmark.environments", description=description)
    names = [package.name for package in PACKAGES]

    def add(option: str, default: object, text: str, **kwargs: Any) -> None:
        parser.add_argument(option, default=default, help=f"{text} (default: %(default)s)", **kwargs)

    parser.add_argument(
        "--packages", nargs="+", default=names, choices=names, metavar="NAME", help=f"some of {', '.join(names)}"
    )
    parser.add_argument("--missing", action="store_true", help="only packages without a record of all environments")
    parser.add_argument("--keep", action="store_true", help="keep the virtual environments, and what was checked")
    add("--python", sys.executable, "the interpreter that makes the virtual environments")
    add("--work", Path("build/environments"), "folder of the virtual environments and the checks' files", type=Path)
    add("--folder", "results/environments", "folder of the records", type=output_folder)
    add("--page", None, "the page's file, by default environments.md in that folder", type=Path)
    add("--install-timeout", 1800, "seconds for each installation", type=count)
    add("--timeout", 900, "seconds for each part of a check", type=count)
    add_epilog(
        parser,
        "examples:\n  python -m benchmark.environments\n  python -m benchmark.environments --packages panda-gym metaworld",
        "It takes about two minutes and two gigabytes a package, of which it keeps none.",
        "Records and the page are written to results/environments (--folder); this repository's own are in\n"
        "benchmark/results/environments and docs/tested_environments.md.",
    )
    return parser.parse_args(argv)


def main(argv: Sequence[str] | None = None) -> None:
    """
    Test the packages one after another, and write the record and the page after each.

    :param argv: the command line; None for that of the process
    """
    args = parse(sys.argv[1:] if argv is None else argv)
    try:
        # Before an installation of minutes
        read_all(args.folder)
    except ValueError as error:
        sys.exit(f"Error: {error}")
    for package in PACKAGES:
        record = args.folder / f"{package.name}.json"
        earlier = tested(package, record)
        if package.name not in args.packages or (args.missing and len(earlier) == len(package.environments)):
            continue
        print(f"{package.name}: installing {' '.join(package.requirements)}", flush=True)
        for found in test(package, args):
            # An interruption or a failed installation loses nothing, and no record mixes two machines or versions
            if earlier <= found["environments"].keys():
                write_json(record, found)
                write_page(args)
        if not earlier <= found["environments"].keys():
            print(f"  {record} stays as it was, with {len(earlier)} environments", flush=True)
    # Also where nothing is left to test, as with other declarations or another page
    write_page(args)


def tested(package: Package, record: Path) -> set[str]:
    """
    Return which environments of a package have been tested.

    :param package: the package
    :param record: the file of its record
    :return: their ids, without those that are not declared any more
    :raises ValueError: if the record is damaged; it names the file and the remedy
    """
    known = read_record(record)["environments"] if record.is_file() else {}
    return {environment.id for environment in package.environments} & known.keys()


def read_record(path: Path) -> dict[str, Any]:
    """
    Read the record of a package.

    :param path: its file
    :return: the record
    :raises ValueError: if it is damaged; it names the file and the remedy
    """
    remedy = "Move it away, and give the same command again, which tests the package anew."
    return read_json(path, ("package", "environments"), remedy)


def test(package: Package, args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """
    Install a package and check its environments.

    :param package: the package
    :param args: the command line
    :return: yields the record after each environment, or once if the package cannot be installed
    """
    folder = (args.work / package.name).resolve()
    installation = install(args.python, PROJECT, package.requirements, folder / "venv", args.install_timeout)
    record: dict[str, Any] = {
        "package": package.name,
        "installation": installation,
        "environments": {},
        "versions": {},
        "other_versions": {},
        "commit": commit(),
        "machine": machine(th.device("cpu")),
        # Windows has no load average
        "load_average": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
    }
    if "failure" in installation:
        print(f"  not installed: {installation['failure']}", flush=True)
        yield record
    for environment in package.environments if "failure" not in installation else ():
        name = canonicalize_name(environment.id.replace("/", "-").replace(" ", "-"))
        found = check(environment, folder / "venv" / "bin" / "python", folder / name, args.timeout, args.keep)
        versions, record["python"] = found.pop("versions"), found.pop("python", None)
        record["versions"] |= {name: versions[name] for name in package.distributions if name in versions}
        record["other_versions"] |= other_versions(versions)
        record["environments"][environment.id] = found
        print(f"  {environment.id}: resumes {found['resumes']}, errors {found['errors'] or 'none'}", flush=True)
        yield record
    if not args.keep:
        shutil.rmtree(folder / "venv", ignore_errors=True)


def other_versions(versions: dict[str, str]) -> dict[str, list[str]]:
    """
    Compare installed versions with the pinned ones.

    :param versions: the installed versions by name
    :return: the installed and the pinned version, by name, where they differ; a local part, such as ``+cpu``, is left out
    """
    pins = read_pins(PROJECT / "constraints.txt")
    public = {name: version.partition("+")[0] for name, version in versions.items()}
    return {name: [version, pins[name]] for name, version in public.items() if version != pins.get(name, version)}


def read_all(folder: Path) -> list[dict[str, Any]]:
    """
    Read the records of all packages.

    :param folder: the folder of the records
    :return: the records, by file
    :raises ValueError: if one is damaged; it names the file and the remedy
    """
    return [read_record(path) for path in sorted(folder.glob("[!.]*.json"))]


def write_page(args: argparse.Namespace) -> None:
    """
    Write the page of all records that the folder has.

    :param args: the command line
    """
    text = page({record["package"]: record for record in read_all(args.folder)})
    write_atomically(args.page or args.folder / "environments.md", text.encode())


if __name__ == "__main__":
    main()
