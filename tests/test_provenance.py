"""What a record says of the code and the machine."""

import subprocess
from pathlib import Path

import pytest
import torch as th

from benchmark.common import provenance


def test_a_commit_is_named_and_changes_to_it_are_marked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(provenance, "__file__", str(tmp_path / "provenance.py"))
    assert provenance.commit() is None
    for command in ("init -q", "config user.name Nobody", "config user.email nobody@example.com"):
        subprocess.run(["git", *command.split()], cwd=tmp_path, check=True)
    (tmp_path / "code.py").write_text("1")
    subprocess.run(["git", "add", "code.py"], cwd=tmp_path, check=True)
    subprocess.run(["git", "commit", "-q", "-m", "First"], cwd=tmp_path, check=True)
    name = provenance.commit()
    assert name is not None
    head = subprocess.run(["git", "rev-parse", "HEAD"], cwd=tmp_path, check=True, capture_output=True, text=True).stdout
    assert head.startswith(name)
    (tmp_path / "code.py").write_text("2")
    assert provenance.commit() == name + "+"


def test_without_git_there_is_no_commit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    assert provenance.commit() is None


@pytest.mark.parametrize("has_bfloat16", [True, False])
def test_a_machine_says_what_cem_computes_in(monkeypatch: pytest.MonkeyPatch, has_bfloat16: bool) -> None:
    monkeypatch.setattr(th.cpu, "get_capabilities", lambda: {"avx512_bf16": has_bfloat16}, raising=False)
    assert provenance.machine(th.device("cpu"))["cem_dtype"] == ("bfloat16" if has_bfloat16 else "float32")


@pytest.mark.parametrize(("load", "words"), [(4.51708984375, ", load average before the start 4.5."), (None, "")])
def test_a_load_average_is_rounded_and_left_out_where_there_is_none(load: float | None, words: str) -> None:
    record = {**provenance.conditions("benchmark.sweep", ["e3"], th.device("cpu")), "load_average": load}
    text = provenance.conditions_in_words(record)
    assert f"commit {record['commit']}{words or '.'}\n\n" in text
    assert ("load average" in text) == bool(words)
