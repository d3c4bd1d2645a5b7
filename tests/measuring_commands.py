"""Measuring commands, and the records that they write."""

import json
from pathlib import Path

import torch as th

from benchmark import checkpoint, latency, runtime, scaling, selector

CPU = th.device("cpu")
COMMANDS = {"checkpoint": checkpoint, "latency": latency, "runtime": runtime, "selector": selector, "scaling": scaling}


def run_command(name: str, folder: Path, *options: str) -> dict:
    """Run a command, and read the record that it writes."""
    COMMANDS[name].main([*options, "--folder", str(folder)])
    assert not list(folder.glob(".*")), "an unfinished file was left behind"
    return json.loads((folder / f"{name}.json").read_text())
