"""The files of SB3's monitors, which a training that goes on must go on in."""

import json
import os
from pathlib import Path


def read_start(path: Path) -> float:
    """
    Read when a monitor's file was begun, from which its times count.

    :param path: the file
    :return: seconds since the epoch
    """
    with open(path) as file:
        return float(json.loads(file.readline().lstrip("#"))["t_start"])


def cut_monitors(path: Path, n_episodes: int | None, n_steps: int) -> None:
    """
    Cut off the last episodes of a monitor's file, in place: whatever has it open to append goes on behind those that are left.

    :param path: the file
    :param n_episodes: how many episodes are left, at most. None for those whose steps are not more than ``n_steps``.
    :param n_steps: the environment's steps
    """
    with open(path, "rb") as file:
        _, columns, *rows = lines = file.readlines()
    # A process that was killed, or a full disk, may have left a part of a row
    rows = [row for row in rows if row.endswith(b"\n")]
    if n_episodes is None:
        column, length, n_episodes = columns.strip().split(b",").index(b"l"), 0, 0
        for row in rows:
            length += int(row.split(b",")[column])
            n_episodes += length <= n_steps
    os.truncate(path, sum(map(len, [*lines[:2], *rows[:n_episodes]])))
