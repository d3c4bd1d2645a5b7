"""The locks on the folders of runs."""

import errno
import socket
import subprocess
import sys
import time

import pytest

from benchmark.sweeps.locks import locked

HOLD = """\
import sys, time
from pathlib import Path
from benchmark.sweeps.locks import locked
with locked([Path(sys.argv[1])]):
    print("held", flush=True)
    time.sleep(float(sys.argv[2]))
"""


@pytest.mark.parametrize("is_held", [False, True])
def test_a_process_says_once_for_whom_it_waits(tmp_path, capsys, is_held):
    folders = [tmp_path / name for name in ("b", "a")]
    if is_held:
        holder = subprocess.Popen([sys.executable, "-c", HOLD, str(folders[0]), "1.5"], stdout=subprocess.PIPE)
        assert holder.stdout.readline() == b"held\n"
    start = time.monotonic()
    with locked(folders):
        waited = time.monotonic() - start
        if is_held:
            assert holder.wait(timeout=10) == 0
    told = capsys.readouterr().out
    if is_held:
        owner = f"process {holder.pid} on host {socket.gethostname()}"
        assert told == f"Waiting for {owner}, which may be suspended, to leave {folders[0]}\n"
    else:
        assert told == ""
    assert (waited > 0.5) == is_held
    # They are free again
    with locked(folders):
        pass
    assert "Waiting" not in capsys.readouterr().out


@pytest.mark.parametrize("number", [errno.ENOSYS, errno.EOPNOTSUPP])
def test_on_a_file_system_without_locks_nobody_waits(number, tmp_path, capsys, fail_to_lock):
    fail_to_lock(number)
    # Two at once, as after a process that was killed
    with pytest.warns(UserWarning, match="cannot be locked") as told, locked([tmp_path]), locked([tmp_path]):
        assert len(told) == 2
    assert "Waiting" not in capsys.readouterr().out


def test_another_error_is_raised(tmp_path, fail_to_lock):
    fail_to_lock(errno.EIO)
    with pytest.raises(OSError, match="Input/output error"), locked([tmp_path]):
        pass
