"""Saved files beside folders of the same name, such as a model's zip beside the folder that the model was exported to."""

import errno
import io
import pathlib
from typing import Any, TypeVar

from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

SelfPathGuard = TypeVar("SelfPathGuard", bound="PathGuard")
# The methods that read a folder, and what it holds, in the order of the error's text
READERS = {"load_weights": "an exported policy", "resume": "training states"}


class PathGuard(OffPolicyAlgorithm):
    """
    An algorithm that reads the file ``name.zip`` or ``name.pkl`` where ``name`` is a folder.

    SB3 adds the suffix only where ``name`` does not exist, and fails to open a folder.
    """

    @classmethod
    def load(
        cls: type[SelfPathGuard], path: str | pathlib.Path | io.BufferedIOBase, *args: Any, **kwargs: Any
    ) -> SelfPathGuard:
        """
        Load a model from a zip-file.

        :param path: path to the file, with or without its suffix, or an open file
        :param args: the algorithm's own arguments
        :param kwargs: the algorithm's own arguments
        :return: the model
        :raises IsADirectoryError: if the path is a folder without a zip-file of the same name beside it
        """
        return super().load(cls._file_of(path, "zip"), *args, **kwargs)

    def set_parameters(self, load_path_or_dict: Any, *args: Any, **kwargs: Any) -> None:
        """
        Load parameters from a zip-file or a nested dictionary.

        :param load_path_or_dict: path to the file, an open file, or the parameters by module
        :param args: the algorithm's own arguments
        :param kwargs: the algorithm's own arguments
        :raises IsADirectoryError: if the path is a folder without a zip-file of the same name beside it
        """
        super().set_parameters(self._file_of(load_path_or_dict, "zip"), *args, **kwargs)

    def load_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool = True) -> None:
        """
        Load a replay buffer from a pickle file.

        :param path: path to the file, with or without its suffix, or an open file
        :param truncate_last_traj: see SB3's method
        :raises IsADirectoryError: if the path is a folder without a pickle file of the same name beside it
        """
        super().load_replay_buffer(self._file_of(path, "pkl"), truncate_last_traj)

    @classmethod
    def _file_of(cls, path: Any, suffix: str) -> Any:
        """Return the file that a path stands for. Return anything that is no path of a folder as it is."""
        if not isinstance(path, str | pathlib.Path) or not pathlib.Path(path).is_dir():
            return path
        file = pathlib.Path(f"{path}.{suffix}")
        if file.is_file():
            return file
        readers = [f"`{name}` reads a folder of {content}" for name, content in READERS.items() if hasattr(cls, name)]
        reason = "; ".join([f"Is a folder, and there is no file {file}", *readers])
        raise IsADirectoryError(errno.EISDIR, reason, str(path))
