"""Writing results."""

import errno
import os
import stat
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

from benchmark.common.tables import markdown_table
from sb3_cgp import CGP
from sb3_cgp.common.files import replace_all, write_atomically


def test_markdown_table_lines_up():
    assert markdown_table(["a", "b"], [["1", "2"], ["3", "4"]]) == "|  a  |  b  |\n| --- | --: |\n| 1   |   2 |\n| 3   |   4 |"


@pytest.mark.parametrize("name", ["save", "save_replay_buffer"])
def test_models_and_buffers_are_saved_as_a_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    model = CGP("MlpPolicy", "Pendulum-v1", buffer_size=10, policy_kwargs=dict(net_arch=[4]))
    save = getattr(model, name)
    save(tmp_path / "new" / "saved")
    (path,) = (tmp_path / "new").iterdir()
    # As SB3 calls it
    assert path.name == {"save": "saved.zip", "save_replay_buffer": "saved.pkl"}[name]
    before = path.read_bytes()
    model.replay_buffer.add(*[np.zeros((1, 3))] * 2, np.zeros((1, 1)), np.zeros(1), np.zeros(1), [{}])
    model.num_timesteps = 7

    def full_disk(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("os.fsync", full_disk)
        with pytest.raises(OSError, match=f"No space left on device, so that this was not written: '.*{path.name}'"):
            save(str(tmp_path / "new" / "saved"))
    assert path.read_bytes() == before
    assert list(path.parent.iterdir()) == [path]
    save(path)
    assert path.read_bytes() != before


def test_failed_write_leaves_the_old_file_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "report.json"
    write_atomically(path, b"old")

    def full_disk(*_: object) -> None:
        raise OSError("No space left on device")

    monkeypatch.setattr("os.replace", full_disk)
    with pytest.raises(OSError, match="No space left"):
        write_atomically(path, b"new")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(("number", "is_passed_on"), [(errno.EINVAL, False), (errno.ENOTSUP, False), (errno.EIO, True)])
def test_a_file_system_that_flushes_no_folders_is_no_error(
    number: int, is_passed_on: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As that of some shared folders of virtual machines."""
    fsync = os.fsync

    def flush(descriptor: int) -> None:
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise OSError(number, os.strerror(number))
        fsync(descriptor)

    monkeypatch.setattr("os.fsync", flush)
    with pytest.raises(OSError, match=str(tmp_path)) if is_passed_on else nullcontext():
        write_atomically(tmp_path / "file", b"content")
    assert (tmp_path / "file").read_bytes() == b"content"


def test_files_of_a_folder_keep_their_permissions_and_links(tmp_path: Path) -> None:
    """As an export that is written anew, for a robot's account that may read it and no more."""
    folder, elsewhere = tmp_path / "folder", tmp_path / "elsewhere"
    folder.mkdir()
    for path, mode in ((folder / "plain", 0o604), (elsewhere, 0o640)):
        path.write_bytes(b"old")
        path.chmod(mode)
    (folder / "linked").symlink_to(elsewhere)
    replace_all(folder, {"plain": b"new", "linked": b"newer"})
    assert (folder / "linked").is_symlink()
    assert ((folder / "plain").read_bytes(), elsewhere.read_bytes()) == (b"new", b"newer")
    assert [stat.S_IMODE(path.stat().st_mode) for path in (folder / "plain", elsewhere)] == [0o604, 0o640]
