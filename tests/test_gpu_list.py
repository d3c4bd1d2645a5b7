"""The list for a GPU that is there for a short time: its order, what is skipped, and the time limit."""

import json
import sys
import time

import pytest
import yaml

from benchmark import gpu_list
from benchmark.gpu_list import DONE, FAILED, STOPPED, TIME_OVER, Step, do_steps, execute, list_steps, parse
from benchmark.sweeps.experiments import load_sweep

STEPS = [Step("tests", ("python", "t")), Step("population", ("python", "p"), takes_minutes=True), Step("e6", ("python", "s"))]


class Fake:
    """Executes nothing: a clock goes on by the seconds of each step, and the exit codes are given."""

    def __init__(self, monkeypatch, seconds=None, codes=None):
        self.now, self.seconds, self.codes = 0.0, seconds or {}, codes or {}
        self.calls = []
        monkeypatch.setattr(gpu_list.time, "monotonic", lambda: self.now)

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


def states(tmp_path):
    return {name: entry["state"] for name, entry in json.loads((tmp_path / "gpu_list.json").read_text()).items()}


def test_the_list_is_in_the_order_of_value_and_its_sweeps_are_valid(tmp_path):
    steps = list_steps(arguments(tmp_path))
    assert [step.name for step in steps] == ["tests", "population", "e6", "e4", "e7", "e8", "e3", "e1"]
    assert steps[0].command[1:3] == ("-m", "pytest")
    for step in steps[2:]:
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
    for step in list_steps(arguments(tmp_path, "--rehearse"))[1:]:
        assert "cuda" not in step.command
        assert step.command[step.command.index("--device") + 1] == "cpu"
        if step.name != "population":
            assert step.command[step.command.index("--steps") + 1] == "40"
            assert yaml.safe_load((tmp_path / "sweeps" / f"{step.name}.yml").read_text())["methods"]


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


def test_only_named_steps_are_done(tmp_path, monkeypatch):
    fake = Fake(monkeypatch)
    do_steps(STEPS, arguments(tmp_path, "--only", "e6"), fake)
    assert fake.names == ["e6"]
    with pytest.raises(SystemExit, match="e99"):
        gpu_list.main(["--only", "e99", "--folder", str(tmp_path)])


@pytest.mark.parametrize(("ignores", "grace"), [(False, 20.0), (True, 0.2)])
def test_a_command_is_asked_to_end_and_then_ended(tmp_path, monkeypatch, ignores, grace):
    monkeypatch.setattr(gpu_list, "TO_END", grace)
    handler = "signal.SIG_IGN" if ignores else "lambda *_: (print('saved', flush=True), exit(143))"
    code = f"import signal, time; signal.signal(signal.SIGTERM, {handler}); print('begun', flush=True); time.sleep(60)"
    start, log = time.monotonic(), tmp_path / "log"
    assert execute([sys.executable, "-c", code], log, 5.0) == TIME_OVER
    assert time.monotonic() - start < 40.0
    assert log.read_text().split() == (["begun"] if ignores else ["begun", "saved"])
    assert execute([sys.executable, "-c", "print('again'); exit(2)"], log, 60.0) == 2
    assert log.read_text().endswith("again\n")
