"""The test of other packages' environments: what fails stays alone, what is compared is compared, and the table says so."""

import json
import sys
import time
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from benchmark import environments
from benchmark.compatibility import check, checking
from benchmark.compatibility import page as page_module
from benchmark.compatibility.checking import summary
from benchmark.compatibility.installing import install, read_pins
from benchmark.compatibility.packages import PACKAGES, Environment, Learning, Package
from benchmark.compatibility.page import page
from benchmark.compatibility.processes import execute
from benchmark.compatibility.texts import in_a_line

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
WRITTEN = {
    "errors": {},
    "warnings": [],
    "doing": None,
    "versions": {"works": "1.2", "numpy": "0.9", "torch": "2.13.0+cpu"},
    "python": "3.11.7",
    "observations": "Box(3,)",
    "actions": "Box(1,)",
    "at_stop": {"a": "1"},
    "at_end": {"a": "2"},
    "why_not_restorable": None,
    "steps_per_second": 80.4,
    "environment_steps_per_second": 12_345.6,
    "export_difference": 0.0,
}


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


def rows_of(text: str) -> dict[str, list[str]]:
    """The table's cells by environment."""
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line.startswith("| ")]
    return {name: cells for name, *cells in rows}


# The command


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
    assert table["shaky: segfaults"] == ["MlpPolicy", "yes", "bit for bit", "yes (0e+00)", "80 (12,346)", "not tested"]
    assert table["shaky: Fine-v0"] == table["shaky: segfaults"]
    assert "- It was not installed: setup.py: swig is missing" in text
    assert "The package contradicts constraints.txt. Other than there: numpy 0.9 (there " in text
    spaces = "Observations: `Box(3,)`; actions: `Box(1,)`."
    assert f"- **segfaults**: {spaces} Failed (stops): the process ended by SIGSEGV" in text
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


# Processes and installations


def test_the_children_of_a_process_that_hangs_end_with_it(tmp_path):
    script = f"(sleep 1.5; touch {tmp_path}/child) & sleep 60"
    assert execute(["sh", "-c", script], tmp_path, tmp_path / "log", 0.5).reason == "the time limit of 0.5 seconds"
    time.sleep(1.7)
    assert not (tmp_path / "child").exists()


def test_a_command_that_is_not_there_is_a_reason(tmp_path):
    ended = execute([str(tmp_path / "nothing")], tmp_path, tmp_path / "log", 1)
    assert (ended.succeeded, ended.reason) == (False, "FileNotFoundError: No such file or directory")


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


# The check

COUNTS = """
import gymnasium as gym
import numpy as np


class Counts(gym.Env):
    observation_space = gym.spaces.Box(-9.0, 9.0, (2,), np.float32)
    action_space = gym.spaces.Box(-2.0, 2.0, (1,), np.float32)
    count = 0.0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = self.np_random.uniform()
        return self.observe(), {}

    def step(self, action):
        self.count += 0.01 * float(action[0]) + 0.001
        return self.observe(), self.count, False, False, {}

    def observe(self):
        return np.array([np.sin(self.count), self.count], np.float32)
"""
LIMITED = "\n\nenv = gym.wrappers.TimeLimit(Counts(), 25)"
METHODS = """
    def get_training_state(self):
        return self.count

    def set_training_state(self, state):
        self.count = {restored}
"""
UNSEEDED = COUNTS.replace("self.np_random.uniform()", "np.random.default_rng().uniform()")


@pytest.fixture
def short(monkeypatch):
    for name, value in dict(LEARNING_STARTS=30, STOP=43, STEPS=60, WARM_UP=2, ALONE=20, EPISODES=2).items():
        monkeypatch.setattr(check, name, value)
    small = dict(policy_kwargs=dict(net_arch=[8]), batch_size=8, cem_samples=8, cem_elites=2)
    monkeypatch.setattr(check, "DEFAULTS", check.DEFAULTS | small)


def checked(folder: Path, code: str, *parts: str, **fields: object) -> dict:
    """Carry out parts of the check in this process, and summarise them."""
    found = {}
    for part in parts:
        report = check.Report(folder / f"{part}.json")
        getattr(check, part)(asdict(Environment("Counts", code, **fields)), folder, report)
        found[part] = json.loads((folder / f"{part}.json").read_text())
    return summary(found)


@pytest.mark.parametrize(
    ("code", "resumes", "repeats"),
    [
        (COUNTS + METHODS.format(restored="state"), "bit for bit", True),
        (COUNTS + METHODS.format(restored="state + 0.01"), "differs", True),
        (COUNTS, "from a new episode", True),
        (UNSEEDED + METHODS.format(restored="state"), "differs", False),
    ],
)
def test_resumption_is_compared_to_the_bit(code, resumes, repeats, short, tmp_path, monkeypatch):
    monkeypatch.setattr(check.CGP, "export", lambda *_: 1 / 0)
    row = checked(tmp_path, code + LIMITED, "whole", "stopped", "resumed")
    assert (row["resumes"], row["repeats"]) == (resumes, repeats)
    assert row["errors"] == {"whole": {"exports": "ZeroDivisionError: division by zero"}}
    assert (row["why_not_restorable"] is None) == (resumes != "from a new episode")
    assert row["steps_per_second"] > 0
    assert row["environment_steps_per_second"] > row["steps_per_second"]


def test_an_export_is_compared_with_predict(short, tmp_path, monkeypatch):
    load_weights = check.CGP.load_weights

    class Shifted:
        """An exported policy that acts otherwise by a tenth of the width of the action space."""

        def __init__(self, folder):
            self.policy = load_weights(folder)

        def predict(self, observations):
            return self.policy.predict(observations)[0] + 0.4, None

    monkeypatch.setattr(check.CGP, "load_weights", Shifted)
    row = checked(tmp_path, COUNTS + LIMITED, "whole")
    assert row["errors"] == {}
    np.testing.assert_allclose(row["export_difference"], 0.1, atol=1e-5)


def test_what_raises_is_named_and_ends_the_check(short, tmp_path):
    row = checked(tmp_path, COUNTS.replace("self.count, False", "1 / 0, False") + LIMITED, "whole")
    assert row["errors"] == {"whole": {"trains": "ZeroDivisionError: division by zero"}}
    row = checked(tmp_path, "import a_package_that_is_not_there", "whole")
    assert row["errors"] == {"whole": {"trains": "ModuleNotFoundError: No module named 'a_package_that_is_not_there'"}}


def test_learning_is_returns_beside_those_of_random_actions(short, tmp_path):
    learning = Learning(50, dict(learning_starts=30, gamma=0.9), normalize=True)
    code = COUNTS.replace("False, False, {}", "False, False, {'is_success': True}") + LIMITED
    code += "\n\nfrom stable_baselines3.common.vec_env import DummyVecEnv\n\none = env\nenv = DummyVecEnv([lambda: one])"
    found = check.Report(tmp_path / "learnt.json")
    check.learnt(asdict(Environment("Counts", code, learning=learning)), tmp_path, found)
    assert [len(found.known[key]) for key in ("returns", "random_returns")] == [2, 2]
    assert (found.known["successes"], found.known["random_successes"]) == (2, 2)
    assert found.known["learning_seconds"] > 0


def test_the_script_runs_outside_of_the_repository(tmp_path):
    """It imports nothing of ``benchmark``, and writes an error where the environment cannot be made."""
    row = checking.check(Environment("Nothing", "import nothing_here"), Path(sys.executable), tmp_path / "check", 300)
    assert row["errors"] == {"whole": {"trains": "ModuleNotFoundError: No module named 'nothing_here'"}}
    assert row["resumes"] is None
    assert "stable-baselines3" in row["versions"]


# The table


def test_a_page_has_returns_successes_and_what_was_noticed(monkeypatch):
    learning = Learning(3_000, {})
    package = Package(
        "works", ("works<2",), ("works",), (Environment("Works-v0", "env = 1", learning=learning),), ("A note.",)
    )
    monkeypatch.setattr("benchmark.compatibility.page.PACKAGES", (package,))
    found = {
        **WRITTEN,
        "resumes": "differs",
        "repeats": False,
        "returns": [-1.0, -2.0],
        "random_returns": [-50.0, -49.0],
        "successes": 19,
        "random_successes": 0,
        "observations": "Box([-1. 0.], [1. inf], (2,), float32)",
        "why_not_restorable": "a.Simulator is unknown and has no get_training_state(): it needs x. b.C is unknown and has no "
        "get_training_state(): it needs x.",
    }
    record = {
        "package": "works",
        "installation": {"pins": "all", "seconds": 1.0},
        "environments": {"Works-v0": found},
        "versions": {"works": "1.2"},
        "other_versions": {},
        "python": "3.11.7",
        "commit": "abc",
        "machine": {"cpu": "A processor", "cores": 2},
        "load_average": 3.4,
    }
    text = page({"works": record})
    cells = ["differs", "yes (0e+00)", "80 (12,346)", "-49.5 → -1.5; 0 → 19 of 20 (3,000 steps)"]
    assert rows_of(text)["works: Works-v0"][2:] == cells
    for line in (
        '`pip install "works<2"`',
        "- Tested: works 1.2, with Python 3.11.7. No version differs from constraints.txt.",
        "- A note.",
        "- Observations: `Box([...], [...], (2,), float32)`; actions: `Box(1,)`.",
        "- Not restored: the state of a.Simulator, b.C is unknown "
        "([what helps](environments.md#environments-of-other-packages)).",
        "Commit abc, on A processor, 2 cores, load average 3.",
        "- Two trainings with one seed differ: the environment does not repeat itself.",
    ):
        assert line in text.splitlines()


def test_the_page_of_the_documentation_is_that_of_the_records():
    root = Path(__file__).parent.parent
    records = [json.loads(path.read_text()) for path in (root / "benchmark/results/environments").glob("*.json")]
    assert records
    # Where the command writes it
    assert f"`{environments.parse([]).folder / 'environments.md'}`" in page({})
    assert (root / "docs/tested_environments.md").read_text() == page({record["package"]: record for record in records})


@pytest.mark.parametrize("package", PACKAGES, ids=lambda package: package.name)
def test_a_declaration_is_whole(package):
    ids = [environment.id for environment in package.environments]
    assert ids
    assert len(set(ids)) == len(ids)
    assert all(name == name.lower().replace("_", "-") for name in package.distributions)
    for environment in package.environments:
        compile(environment.code, environment.id, "exec")
        assert "\nenv = " in environment.code
        assert environment.replay_buffer in (None, *check.REPLAY_BUFFERS)
        json.dumps(asdict(environment))
