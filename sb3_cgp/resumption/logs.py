"""Continue SB3's logs in a resumed training: the files of monitors, and TensorBoard's events."""

import json
import os
from pathlib import Path

from stable_baselines3.common.logger import KVWriter, Logger, TensorBoardOutputFormat, make_output_format


def read_start(path: Path) -> float:
    """
    Return the start time of a monitor's file. The times of the episodes in the file are relative to it.

    :param path: the file
    :return: seconds since the epoch
    """
    with open(path) as file:
        return float(json.loads(file.readline().lstrip("#"))["t_start"])


def cut_monitors(path: Path, n_episodes: int | None, n_steps: int) -> None:
    """
    Remove the last episodes from a monitor's file, in place. A process that has the file open for appending then continues
    after the remaining episodes.

    :param path: the file
    :param n_episodes: the largest number of episodes to keep. None keeps those that ended within ``n_steps`` steps.
    :param n_steps: the environment's steps
    """
    with open(path, "rb") as file:
        _, columns, *rows = lines = file.readlines()
    # A killed process or a full disk may have left an incomplete row
    rows = [row for row in rows if row.endswith(b"\n")]
    if n_episodes is None:
        column, length, n_episodes = columns.strip().split(b",").index(b"l"), 0, 0
        for row in rows:
            length += int(row.split(b",")[column])
            n_episodes += length <= n_steps
    os.truncate(path, sum(map(len, [*lines[:2], *rows[:n_episodes]])))


def tensorboard_folder(logger: Logger) -> str | None:
    """
    Return the folder of TensorBoard's events.

    :param logger: the training's logger
    :return: the absolute path; None if the logger writes no events
    """
    writes_events = any(isinstance(each, TensorBoardOutputFormat) for each in logger.output_formats)
    return os.path.abspath(logger.dir) if writes_events and logger.dir is not None else None


def continued_logger(folder: str, first_step: int, verbose: int) -> Logger:
    """
    Create the logger that SB3 creates for TensorBoard, in a folder that already has events.

    :param folder: the folder
    :param first_step: TensorBoard hides existing events from this step on, as the resumed training writes them again
    :param verbose: the verbosity level; at 1 and above, the log is also printed
    :return: the logger
    """
    outputs: list[KVWriter] = [make_output_format("stdout", folder)] if verbose >= 1 else []
    return Logger(folder, [*outputs, _ContinuedTensorBoard(folder, first_step)])


class _ContinuedTensorBoard(TensorBoardOutputFormat):
    """SB3's writer for TensorBoard with the argument ``purge_step``, which SB3's constructor does not accept."""

    def __init__(self, folder: str, first_step: int):
        # A late import, as a plain installation has no TensorBoard
        from torch.utils.tensorboard import SummaryWriter

        self.writer = SummaryWriter(log_dir=folder, purge_step=first_step)
        self._is_closed = False
