"""The list for a GPU that is there for a short time: its order, what is skipped, and the time limit."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest
import yaml

from benchmark import gpu_list
from benchmark.common import listed_steps
from benchmark.common.listed_steps import DONE, FAILED, STOPPED, Step, do_steps, execute
from benchmark.common.measuring import TIME_OVER
from benchmark.gpu_list import list_steps, parse
from benchmark.sweeps.experiments import load_sweep
from benchmark.sweeps.sharing import common_settings

ROOT = Path(__file__).parents[1]
STEPS = [Step("tests", ("python", "t")), Step("population", ("python", "p"), takes_minutes=True), Step("e6", ("python", "s"))]


class Fake:
    """Executes nothing: a clock goes on by the seconds of each step, and the exit codes are given."""

    def __init__(self, monkeypatch, seconds=None, codes=None):
        self.now, self.seconds, self.codes = 0.0, seconds or {}, codes or {}
        self.calls = []
        monkeypatch.setattr(listed_steps.time, "monotonic", lambda: self.now)

    def __call__(self, command, log, seconds):
        self.calls.append((log.stem, list(command), seconds))
        self.now += min(self.seconds.get(log.stem, 1.0), seconds)
        is_over = self.seconds.get(log.stem, 1.0) > seconds
        return TIME_OVER if is_over else self.codes.get(log.stem, 0)

    @property
    def names(self):
        return [name for name, *_ in self.calls]


def arguments(tmp_path, *options):
    return parse([*options, "--folder", str(tmp_path)])


def sweep_steps(args):
    """The sweeps' steps, with their files."""
    gpu_list.write_sweep_files(args)
    return [step for step in list_steps(args) if step.name in gpu_list.SWEEPS]


def option(step, name):
    return step.command[step.command.index(name) + 1]


def states(tmp_path):
    return {name: entry["state"] for name, entry in json.loads((tmp_path / "gpu_list.json").read_text()).items()}


def test_the_list_is_in_the_order_of_value_and_its_sweeps_are_valid(tmp_path):
    steps, sweeps = list_steps(arguments(tmp_path)), sweep_steps(arguments(tmp_path))
    tests = [f"test_{name}" for name in gpu_list.TESTS]
    assert [step.name for step in steps] == [*tests, "population", "e6", "e4", "e7", "e8", "e3", "e1"]
    # A file each, so that a time limit ends none but the last
    for step, name in zip(steps, tests, strict=False):
        assert step.command[1:3] == ("-m", "pytest")
        assert [part for part in step.command if part.startswith("tests/")] == [f"tests/{name}.py"]
        assert (ROOT / "tests" / f"{name}.py").is_file()
        assert not step.continues
    assert sweeps == steps[-6:]
    for step in sweeps:
        options = dict(zip(step.command, step.command[1:], strict=False))
        assert (options["--population"], options["--steps"], options["--device"]) == ("32", "300000", "cuda")
        start, stop = step.command.index("--methods") + 1, step.command.index("--population")
        methods = step.command[start:stop]
        assert methods[:2] == ("CGP-Online", "CGP-Light")
        # The paper's runs with the light setting among its methods
        sweep = load_sweep(step.command[3], dict(steps=300_000), methods)
        assert sweep.name == step.name
        paper = load_sweep(step.name, dict(steps=300_000))
        of_paper = {(run.method, run.configuration) for run in paper.runs() if run.method in methods}
        assert of_paper <= {(run.method, run.configuration) for run in sweep.runs()}
        tasks = step.command[step.command.index("--task") + 1 : step.command.index("--steps")]
        assert tasks == (gpu_list.OTHER_TASKS if step.name == "e1" else ("HalfCheetah-v5",))
        assert set(tasks) <= set(paper.file.tasks)


def test_a_rehearsal_is_tiny_and_on_the_cpu(tmp_path):
    args = arguments(tmp_path, "--rehearse")
    gpu_list.write_sweep_files(args)
    for step in list_steps(args)[1:]:
        assert "cuda" not in step.command
        assert option(step, "--device") == "cpu"
        if step.name != "population":
            assert option(step, "--steps") == "40"
            assert yaml.safe_load((args.folder / "sweeps" / f"{step.name}.yml").read_text())["methods"]


def test_a_rehearsal_leaves_the_list_to_do(tmp_path, monkeypatch):
    fake = Fake(monkeypatch)
    for options in (["--rehearse"], []):
        args = arguments(tmp_path, *options)
        do_steps(list_steps(args), args, fake)
    assert fake.names[:3] == ["test_population_cuda_graphs", "population", "e6"]
    assert fake.names[8:] == [step.name for step in list_steps(arguments(tmp_path))]


@pytest.mark.parametrize("code", [0, 1, TIME_OVER])
def test_a_step_whose_command_has_changed_is_done_again(code, tmp_path, monkeypatch):
    args = arguments(tmp_path, "--minutes", "9")
    do_steps(STEPS, args, Fake(monkeypatch, codes=dict.fromkeys(["population", "e6"], code)))
    changed = [*STEPS[:2], Step("e6", ("python", "s", "--steps", "9"))]
    again = Fake(monkeypatch)
    do_steps(changed, args, again)
    # Minutes, which differ by the call, are no change
    assert again.names == (["population", "e6"] if code == TIME_OVER else ["e6"])
    assert json.loads((tmp_path / "gpu_list.json").read_text())["e6"]["seconds"] == 1.0


def test_a_test_file_that_does_not_fit_into_a_call_does_not_keep_the_others_from_theirs(tmp_path, monkeypatch):
    steps = [Step(name, ("python", name), continues=False) for name in ("test_a", "test_b")] + STEPS[1:]
    seconds = {"test_a": 300.0, "test_b": 300.0}

    def call(folder):
        fake = Fake(monkeypatch, seconds)
        do_steps(steps, arguments(folder, "--minutes", "9"), fake)
        return fake.names

    assert [call(tmp_path), call(tmp_path)] == [["test_a", "test_b"], ["test_b", "population", "e6"]]
    # Longer than all of a call's time: it would take that of each one
    seconds["test_b"] = 500.0
    other = tmp_path / "other"
    assert [call(other), call(other), call(other)] == [["test_a", "test_b"], ["test_b"], ["population", "e6"]]
    assert states(other)["test_b"] == FAILED


def test_an_internal_error_of_pytest_is_a_failure(tmp_path, monkeypatch):
    do_steps(STEPS, arguments(tmp_path), Fake(monkeypatch, codes={"tests": int(pytest.ExitCode.INTERNAL_ERROR)}))
    assert states(tmp_path)["tests"] == FAILED
    assert TIME_OVER not in list(pytest.ExitCode)


def test_listing_the_steps_writes_nothing(tmp_path, capsys):
    gpu_list.main(["--list", "--folder", str(tmp_path)])
    assert "e1: to do" in capsys.readouterr().out
    assert list(tmp_path.iterdir()) == []


def test_the_sizes_of_populations_are_those_of_the_documentation(tmp_path):
    sizes = {}
    for step in sweep_steps(arguments(tmp_path)):
        methods = step.command[step.command.index("--methods") + 1 : step.command.index("--population")]
        tasks = step.command[step.command.index("--task") + 1 : step.command.index("--steps")]
        found = Counter(common_settings(run) for run in load_sweep(step.command[3], dict(tasks=tasks), methods).runs())
        found.pop(None, 0)
        sizes[step.name] = str(max(found.values()))
    text = (ROOT / "CONTRIBUTING.md").read_text()
    assert {name: size for size, name in re.findall(r"(\d+)(?: agents)? in\s+`(e\d)`", text)} == sizes


def test_what_is_done_is_skipped_and_what_has_failed_is_repeated_on_demand(tmp_path, monkeypatch):
    fake = Fake(monkeypatch, codes={"tests": 1})
    do_steps(STEPS, arguments(tmp_path), fake)
    assert fake.names == ["tests", "population", "e6"]
    assert states(tmp_path) == {"tests": FAILED, "population": DONE, "e6": DONE}
    again = Fake(monkeypatch)
    do_steps(STEPS, arguments(tmp_path), again)
    assert again.names == []
    do_steps(STEPS, arguments(tmp_path, "--retry"), again)
    assert again.names == ["tests"]
    assert set(states(tmp_path).values()) == {DONE}


def test_the_time_limit_stops_a_step_which_goes_on_in_the_next_call(tmp_path, monkeypatch):
    fake = Fake(monkeypatch, seconds={"tests": 100.0, "population": 500.0})
    do_steps(STEPS, arguments(tmp_path, "--minutes", "9"), fake)
    # 45 seconds of the nine minutes are left for a step to end
    assert [(name, seconds) for name, _, seconds in fake.calls] == [("tests", 495.0), ("population", 395.0)]
    assert fake.calls[1][1][-2:] == ["--minutes", f"{395 / 60 - 0.5:.2f}"]
    assert states(tmp_path) == {"tests": DONE, "population": STOPPED}
    again = Fake(monkeypatch)
    do_steps(STEPS, arguments(tmp_path, "--minutes", "9"), again)
    assert again.names == ["population", "e6"]
    assert set(states(tmp_path).values()) == {DONE}


def test_a_damaged_record_is_named(tmp_path):
    path = tmp_path / "gpu_list.json"
    path.write_text("[]")
    with pytest.raises(SystemExit, match=rf"^Error: {path} must hold a mapping in JSON.*Move it away"):
        gpu_list.main(["--folder", str(tmp_path)])


def test_only_named_steps_are_done(tmp_path, monkeypatch):
    fake = Fake(monkeypatch)
    do_steps(STEPS, arguments(tmp_path, "--only", "e6"), fake)
    assert fake.names == ["e6"]
    with pytest.raises(SystemExit, match="e99"):
        gpu_list.main(["--only", "e99", "--folder", str(tmp_path)])


@pytest.mark.parametrize(("ignores", "grace"), [(False, 20.0), (True, 0.2)])
def test_a_command_is_asked_to_end_and_then_ended(tmp_path, monkeypatch, ignores, grace):
    monkeypatch.setattr(listed_steps, "TO_END", grace)
    handler = "signal.SIG_IGN" if ignores else "lambda *_: (print('saved', flush=True), exit(143))"
    code = f"import signal, time; signal.signal(signal.SIGTERM, {handler}); print('begun', flush=True); time.sleep(60)"
    start, log = time.monotonic(), tmp_path / "log"
    assert execute([sys.executable, "-c", code], log, 5.0) == TIME_OVER
    assert time.monotonic() - start < 40.0
    assert log.read_text().split() == (["begun"] if ignores else ["begun", "saved"])
    assert execute([sys.executable, "-c", "print('again'); exit(2)"], log, 60.0) == 2
    assert log.read_text().endswith("again\n")


@pytest.mark.skipif(os.name != "posix", reason="signals are those of POSIX")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_an_interrupted_list_ends_its_step(number, tmp_path):
    """The step writes its process's number, and an ended one has none."""
    step = "import os, time; print(os.getpid(), flush=True); time.sleep(60)"
    script = f"""
import sys
from benchmark import gpu_list
gpu_list.list_steps = lambda args: [gpu_list.Step("step", (sys.executable, "-c", {step!r}))]
gpu_list.main(["--folder", sys.argv[1]])
"""
    process = subprocess.Popen([sys.executable, "-c", script, str(tmp_path)], cwd=ROOT, stderr=subprocess.DEVNULL)
    log, start = tmp_path / "step.log", time.monotonic()
    while not (log.exists() and log.read_text().endswith("\n")):
        assert time.monotonic() - start < 60.0
        time.sleep(0.05)
    process.send_signal(number)
    assert process.wait(30.0) != 0
    with pytest.raises(ProcessLookupError):
        os.kill(int(log.read_text()), 0)
