"""What a figure was measured with: versions and hardware, for the records beside it."""

import os
import platform
from importlib import metadata
from pathlib import Path
from typing import Any

import torch as th

PACKAGES = ("sb3-cgp", "rl_zoo3", "stable_baselines3", "sb3_contrib", "torch", "gymnasium", "mujoco", "numpy")


def package_versions() -> dict[str, str | None]:
    """
    List the versions of Python and of the packages that can change a result.

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
    Name the processor as its system does.

    :return: the name; the architecture's where the system gives no better
    """
    # platform.processor() is empty or only the architecture on Linux
    cpu_info = Path("/proc/cpuinfo")
    if cpu_info.is_file():
        for line in cpu_info.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def machine(device: th.device) -> dict[str, Any]:
    """
    Describe the hardware in use.

    :param device: where the networks live
    :return: operating system, processor, cores, PyTorch's threads, device and the GPU's name if it is one
    """
    return {
        "system": platform.platform(),
        "cpu": cpu_model(),
        "cores": os.cpu_count(),
        "torch_threads": th.get_num_threads(),
        "device": str(device),
        "gpu": th.cuda.get_device_name(device) if device.type == "cuda" else None,
    }
