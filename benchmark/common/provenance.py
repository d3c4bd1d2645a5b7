"""The conditions of a measurement for its record: command, commit, versions and hardware."""

import os
import platform
import shlex
import subprocess
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import torch as th

from sb3_cgp.fast.scoring import scoring_dtype

PACKAGES = (
    "sb3-cgp",
    "rl_zoo3",
    "stable_baselines3",
    "sb3_contrib",
    "sbx-rl",
    "torch",
    "onnxruntime",
    "jax",
    "gymnasium",
    "mujoco",
    "envpool",
    "numpy",
)


def package_versions() -> dict[str, str | None]:
    """
    Return the versions of Python and of the packages that can change a result.

    :return: version by name; None for a package that is not installed
    """
    versions: dict[str, str | None] = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            versions[package] = None
    return versions


def cpu_model() -> str:
    """
    Return the name of the processor.

    :return: the name; that of the architecture where the system knows no other
    """
    # On Linux, platform.processor() is empty or the architecture only
    cpu_info = Path("/proc/cpuinfo")
    if cpu_info.is_file():
        for line in cpu_info.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def machine(device: th.device) -> dict[str, Any]:
    """
    Describe the hardware.

    :param device: device of the networks
    :return: operating system, processor, its instruction set and CEM's data type on it, cores, PyTorch's threads, device, and
        the name of the GPU
    """
    return {
        "system": platform.platform(),
        "cpu": cpu_model(),
        "cpu_capability": th.backends.cpu.get_cpu_capability(),
        # The meaning of `cem_dtype="auto"` on this hardware
        "cem_dtype": str(scoring_dtype("auto", device)).removeprefix("torch."),
        "cores": os.cpu_count(),
        "torch_threads": th.get_num_threads(),
        "device": str(device),
        "gpu": th.cuda.get_device_name(device) if device.type == "cuda" else None,
    }


def processor(hardware: dict[str, Any]) -> str:
    """
    Return the name of the processor that trains: times on different ones cannot be compared.

    :param hardware: a description by :func:`machine`
    :return: the GPU's name, or the CPU's with its instruction set, as CPUs of different generations can have one name
    """
    return hardware["gpu"] or f"{hardware['cpu']} ({hardware['cpu_capability']})"


def processors_of_commands(commands: Sequence[dict[str, Any]]) -> list[str]:
    """
    List the processors on which commands trained.

    :param commands: records with the field "machine" of :func:`conditions`
    :return: their names by :func:`processor`, each once, in alphabetical order
    """
    return sorted({processor(command["machine"]) for command in commands})


def commit() -> str | None:
    """
    Return the commit of the code.

    :return: the commit of the clone that holds this file, with "+" if files differ from it; None outside of a clone
    """
    git = ["git", "-C", str(Path(__file__).parent)]
    try:
        name = subprocess.run([*git, "rev-parse", "--short=12", "HEAD"], capture_output=True, text=True, check=True).stdout
        changes = subprocess.run([*git, "status", "--porcelain", "-uno"], capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return None
    return name.strip() + "+" * bool(changes.strip())


def conditions(module: str, argv: Sequence[str], device: th.device) -> dict[str, Any]:
    """
    Describe the conditions of a measurement.

    :param module: the command's module
    :param argv: its arguments
    :param device: device of the networks
    :return: the command line, the commit, the versions, the hardware, and the load average before the measurement
    """
    return {
        "command": shlex.join(["python", "-m", module, *argv]),
        "commit": commit(),
        "versions": package_versions(),
        "machine": machine(device),
        # Windows has no load average
        "load_average": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
    }


def conditions_in_words(record: dict[str, Any]) -> str:
    """
    Describe the conditions of a measurement as text.

    :param record: a record with the fields of :func:`conditions`
    :return: two paragraphs, in Markdown
    """
    hardware = record["machine"]
    place = hardware["gpu"] or hardware["device"]
    threads = f"{hardware['torch_threads']} thread" + "s" * (hardware["torch_threads"] > 1)
    versions = ", ".join(f"{package} {version}" for package, version in record["versions"].items() if version is not None)
    before = record["load_average"]
    load = "" if before is None else f", load average before the start {before:.1f}"
    return (
        f"`{record['command']}` on {hardware['cpu']} ({hardware['cpu_capability']}, {hardware['cores']} cores), "
        f"{threads}, networks on {place}, CEM by default in {hardware['cem_dtype']}, commit {record['commit']}"
        f"{load}.\n\n{versions}."
    )
