"""Continue SB3's logs in a resumed training: the files of monitors, and TensorBoard's events."""

import json
import os
from pathlib import Path

from stable_baselines3.common.logger import KVWriter, Logger, TensorBoardOutputFormat, make_output_format


def read_start(path: Path) -> float:
    """
    Return the time at which a monitor's file was started, which its times count from.

    :param path: the file
    :return: seconds since the epoch
    """
    with open(path) as file:
        return float(json.loads(file.readline().lstrip("#"))["t_start"])


def cut_monitors(path: Path, n_episodes: int | None, n_steps: int) -> None:
    """
    Cut off the last episodes of a monitor's file, in place, so that a process that has it open to append continues after the
    remaining ones.

    :param path: the file
    :param n_episodes: the largest number of episodes to keep. None keeps those that ended within ``n_steps`` steps.
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


def continued_logger(folder: str, first_step: int, verbose: int) -> Logger:
    """
    Make the logger that SB3 makes for TensorBoard, in a folder that already has events.

    :param folder: the folder
    :param first_step: the step from which on TensorBoard hides the existing events, as they are about to be written again
    :param verbose: the verbosity level; from 1 on, the log is printed, too
    :return: the logger
    """
    outputs: list[KVWriter] = [make_output_format("stdout", folder)] if verbose >= 1 else []
    return Logger(folder, [*outputs, _ContinuedTensorBoard(folder, first_step)])


class _ContinuedTensorBoard(TensorBoardOutputFormat):
    """SB3's writer for TensorBoard, with ``purge_step``, which SB3's constructor does not take."""

    def __init__(self, folder: str, first_step: int):
        # Late, as it imports TensorBoard
        from torch.utils.tensorboard import SummaryWriter

        self.writer = SummaryWriter(log_dir=folder, purge_step=first_step)
        self._is_closed = False
