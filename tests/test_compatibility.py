"""The test of other packages' environments: what fails, crashes or hangs stays alone, and records are kept."""

import json
import time
from pathlib import Path

import pytest
from compatibility_records import WRITTEN, rows_of

from benchmark import environments
from benchmark.compatibility import checking
from benchmark.compatibility import page as page_module
from benchmark.compatibility.installing import install, read_pins
from benchmark.compatibility.package_types import Environment, Package

# Notes each call; `-m venv` puts a copy of the stand-in where the environment's interpreter would be
STAND_IN = """#!/bin/sh
echo "$*" >> "$CALLS"
case "$*" in
  "-m venv "*) mkdir -p "$3/bin" && cp "$0" "$3/bin/python" ;;
  *"-c /"*"/constraints.txt "*" contradicts"*)
    case "$*" in *venv/constraints.txt*) exit 0 ;; esac
    echo "ERROR: Cannot install these because these package versions have conflicting dependencies." && exit 1 ;;
  *"pip install"*" fails") echo "ERROR: /home/me/x/setup.py: swig is missing"; echo "ERROR: other"; exit 1 ;;
  *"pip install"*" hangs") sleep 60 ;;
  *"check.py stopped"*segfaults*) echo '{"doing": "stops", "errors": {}, "warnings": []}' > "$3/stopped.json"; kill -SEGV $$ ;;
  *"check.py whole"*sleeps*) sleep 60 & sleep 60 ;;
  *"check.py whole"*aborts*) echo "$COMPLETE" > "$3/whole.json"; kill -ABRT $$ ;;
  *"check.py"*) echo "$WRITTEN" > "$3/$2.json" ;;
esac
"""


def fake(name: str, requirement: str, *ids: str) -> Package:
    return Package(name, (requirement,), ("works",), tuple(Environment(each, "env = None") for each in ids))


FAKES = (
    fake("broken", "fails", "Broken-v0"),
    fake("endless", "hangs", "Endless-v0"),
    fake("shaky", "installs", "segfaults", "sleeps", "Fine-v0"),
    fake("old", "contradicts", "Old-v0"),
)


@pytest.fixture
def stand_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = tmp_path / "python"
    path.write_text(STAND_IN)
    path.chmod(0o755)
    monkeypatch.setenv("CALLS", str(tmp_path / "calls"))
    monkeypatch.setenv("WRITTEN", json.dumps(WRITTEN))
    monkeypatch.setenv("COMPLETE", json.dumps(WRITTEN | {"complete": True}))
    return path


@pytest.fixture
def fakes(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("benchmark.environments", "benchmark.compatibility.page"):
        monkeypatch.setattr(f"{module}.PACKAGES", FAKES)


def run(stand_in: Path, folder: Path, *arguments: str) -> dict[str, dict]:
    environments.main(
        ["--python", str(stand_in), "--work", str(folder / "work"), "--folder", str(folder / "records"), *arguments]
    )
    return {path.stem: json.loads(path.read_text()) for path in (folder / "records").glob("*.json")}


def test_what_fails_crashes_or_hangs_stays_alone(stand_in, fakes, tmp_path):
    started = time.monotonic()
    records = run(stand_in, tmp_path, "--install-timeout", "2", "--timeout", "2")
    assert time.monotonic() - started < 30
    assert records["broken"]["installation"] == {"failure": "setup.py: swig is missing"}
    assert records["endless"]["installation"] == {"failure": "the installation ended by the time limit of 2 seconds"}
    shaky = records["shaky"]["environments"]
    assert shaky["segfaults"]["errors"] == {"stopped": {"stops": "the process ended by SIGSEGV"}}
    assert shaky["sleeps"]["errors"] == {"whole": {"starts": "the process ended by the time limit of 2 seconds"}}
    assert (shaky["Fine-v0"]["errors"], shaky["Fine-v0"]["resumes"]) == ({}, "bit for bit")
    assert records["old"]["installation"]["pins"] == ["torch", "stable-baselines3"]
    assert list((tmp_path / "work").glob("*/venv")) == []
    text = (tmp_path / "records" / "environments.md").read_text()
    table = rows_of(text)
    assert table["broken: Broken-v0"] == ["MlpPolicy", "not installed", "–", "–", "–", "–"]
    assert table["shaky: sleeps"] == ["MlpPolicy", "no", "–", "–", "–", "–"]
    assert table["shaky: segfaults"] == ["MlpPolicy", "yes", "bit for bit", "yes (0e+00)", "80 (12,346)", "–"]
    assert table["shaky: Fine-v0"] == table["shaky: segfaults"]
    assert "- It was not installed: setup.py: swig is missing" in text
    assert "The package contradicts constraints.txt. Other than there: numpy 0.9 (there " in text
    assert "- **segfaults**: Failed (stops): the process ended by SIGSEGV" in text
    assert str(tmp_path) not in text


def test_named_packages_are_tested_and_the_others_kept(stand_in, fakes, tmp_path):
    records = run(stand_in, tmp_path, "--packages", "shaky", "--timeout", "1")
    assert list(records) == ["shaky"]
    assert "Not tested yet: broken, endless, old." in (tmp_path / "records" / "environments.md").read_text()
    records = run(stand_in, tmp_path, "--packages", "shaky", "old", "--missing")
    assert sorted(records) == ["old", "shaky"]
    assert sum("check.py whole" in line and "sleeps" in line for line in (tmp_path / "calls").read_text().splitlines()) == 1
    with pytest.raises(SystemExit):
        run(stand_in, tmp_path, "--packages", "unknown")


def test_a_damaged_record_is_named_before_anything_is_installed(stand_in, fakes, tmp_path):
    path = tmp_path / "records" / "of mine.json"
    path.parent.mkdir(exist_ok=True)
    path.write_text("{}")
    with pytest.raises(SystemExit, match=rf"^Error: {path} lacks package, environments\. Move it away"):
        run(stand_in, tmp_path)


def test_a_crash_at_the_end_of_a_process_is_not_one_of_the_training(stand_in, tmp_path):
    environment = Environment("aborts", "env = None")
    for _ in range(2):
        # The second check does not repeat the part
        found = checking.check(environment, stand_in, tmp_path / "aborts", 10, reuse=True)
        assert found["errors"] == {"whole": {"ends": "the process ended by SIGABRT"}}
        assert found["resumes"] == "bit for bit"
        assert page_module._cells(environment, found)[:2] == ["yes", "bit for bit"]


def test_a_record_is_not_replaced_by_one_of_fewer_environments(stand_in, fakes, tmp_path, monkeypatch):
    options = ("--packages", "shaky", "--timeout", "1")
    before = run(stand_in, tmp_path, *options)["shaky"]
    assert list(before["environments"]) == ["segfaults", "sleeps", "Fine-v0"]

    def after(name, replacement):
        with monkeypatch.context() as patch:
            patch.setattr(environments, name, replacement)
            try:
                return run(stand_in, tmp_path, *options)["shaky"]
            except KeyboardInterrupt:
                return json.loads((tmp_path / "records" / "shaky.json").read_text())

    assert after("install", lambda *_: {"failure": "no network"}) == before
    found = iter([{"versions": {}, "resumes": None, "errors": {}}])

    def interrupted(*_):
        for each in found:
            return each
        raise KeyboardInterrupt

    assert after("check", interrupted) == before
    assert after("check", lambda *_: {"versions": {"works": "9"}, "resumes": None, "errors": {}})["versions"] == {"works": "9"}


def test_a_record_that_lacks_an_environment_is_missing(stand_in, fakes, tmp_path):
    options = ("--packages", "old", "shaky", "--timeout", "1", "--missing")
    records = run(stand_in, tmp_path, *options)
    del records["shaky"]["environments"]["Fine-v0"]
    (tmp_path / "records" / "shaky.json").write_text(json.dumps(records["shaky"]))
    (tmp_path / "calls").unlink()
    assert "Fine-v0" in run(stand_in, tmp_path, *options)["shaky"]["environments"]
    assert "Old-v0" not in (tmp_path / "calls").read_text()


def test_a_page_may_be_elsewhere(stand_in, fakes, tmp_path):
    run(stand_in, tmp_path, "--packages", "old", "--page", str(tmp_path / "docs" / "page.md"))
    assert "old: Old-v0" in (tmp_path / "docs" / "page.md").read_text()
    assert not (tmp_path / "records" / "environments.md").exists()


def test_pins_that_contradict_a_package_are_dropped_but_for_pytorchs(stand_in, tmp_path):
    (tmp_path / "constraints.txt").write_text(
        "# a comment\nNumPy==2.4.6 ; python_version >= '3.0'\nold==1 ; python_version < '3.0'\n"
    )
    assert read_pins(tmp_path / "constraints.txt") == {"numpy": "2.4.6"}
    with open(tmp_path / "constraints.txt", "a") as file:
        file.write("torch==2.13.0\nstable-baselines3==2.9.2\n")
    venv = tmp_path / "work" / "venv"
    assert install(str(stand_in), tmp_path, ("contradicts",), venv, 10)["pins"] == ["torch", "stable-baselines3"]
    assert (venv / "constraints.txt").read_text() == "torch==2.13.0\nstable-baselines3==2.9.2\n"
    calls = [line for line in (tmp_path / "calls").read_text().splitlines() if "pip install" in line]
    assert [line.partition("-c ")[2].split()[0] for line in calls] == [
        str(tmp_path / "constraints.txt"),
        str(venv / "constraints.txt"),
    ]
    # What is installed is not installed again, unless other requirements are wanted
    assert install(str(stand_in), tmp_path, ("contradicts",), venv, 10)["pins"] == ["torch", "stable-baselines3"]
    assert "failure" in install(str(stand_in), tmp_path, ("fails",), venv, 10)
    assert "failure" in install(str(stand_in), tmp_path, ("fails",), venv, 10)
    assert (tmp_path / "calls").read_text().count("pip install") == 4
