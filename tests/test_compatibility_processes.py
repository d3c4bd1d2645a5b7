"""Processes of the test of other packages' environments, and their messages."""

import time

import pytest

from benchmark.compatibility.processes import execute
from benchmark.compatibility.texts import in_a_line


def test_the_children_of_a_process_that_hangs_end_with_it(tmp_path):
    script = f"(sleep 1.5; touch {tmp_path}/child) & sleep 60"
    assert execute(["sh", "-c", script], tmp_path, tmp_path / "log", 0.5).reason == "the time limit of 0.5 seconds"
    time.sleep(1.7)
    assert not (tmp_path / "child").exists()


def test_a_command_that_is_not_there_is_a_reason(tmp_path):
    ended = execute([str(tmp_path / "nothing")], tmp_path, tmp_path / "log", 1)
    assert (ended.succeeded, ended.reason) == (False, "FileNotFoundError: No such file or directory")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a\n  b", "a b"),
        ("File /home/me/venv/lib/x.py fails", "File x.py fails"),
        ("ERROR: file:///opt/wheels/y.whl", "ERROR: y.whl"),
        ("see https://example.org/a/b, and 1/2", "see https://example.org/a/b, and 1/2"),
        ("x" * 1_501, "x" * 1_497 + "..."),
    ],
)
def test_messages_are_lines_without_paths(text, expected):
    assert in_a_line(text) == expected
