"""The Makefile's set-up, with a stand-in for Python that installs nothing and notes what it was asked."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
REQUIREMENTS = ("setup.cfg", "setup.py", "pyproject.toml", "constraints.txt", "_build_backend.py", "sb3_cgp/version.txt")
FILES = ("Makefile", "constraints-oldest.txt", *REQUIREMENTS)

pytestmark = pytest.mark.skipif(shutil.which("make") is None, reason="needs make")

# Notes each call, with <> around an argument that has spaces; `-m venv` puts copies of the stand-in where the
# environment's interpreter and import-linter would be; $FAIL names what fails.
STAND_IN = """#!/bin/sh
for argument; do
  case "$argument" in *" "*) printf "<%s> " "$argument" ;; *) printf "%s " "$argument" ;; esac
done >> "$CALLS"
echo >> "$CALLS"
# Ctrl-C, which reaches the shell of the recipe, too
case "$INTERRUPT$*" in yes"-m rl_zoo3.train"*) kill -INT $PPID ;; esac
case "$*" in
  --version) echo "Python 3.9.1" ;;
  "-c import sys"*) [ -z "$OLD" ] ;;
  "-m venv"*)
    for last; do :; done
    mkdir -p $last/bin
    for program in python lint-imports; do cp "$0" $last/bin/$program && chmod +x $last/bin/$program; done ;;
  "-m benchmark.plan"*) echo "250 4 $WARM_UP" ;;
  *"$FAIL"*) [ -z "$FAIL" ] ;;
esac
"""


class Clone:
    """A fresh clone in a folder whose name has spaces."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "a fresh clone"
        for name in FILES:
            (self.folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, self.folder / name)
        self.python = folder / "python"
        self.python.write_text(STAND_IN)
        self.python.chmod(0o755)
        self.calls_file = folder / "calls"

    def make(self, *arguments: str, **environment: str) -> tuple[list[str], "subprocess.CompletedProcess[str]"]:
        """Run make; return what the stand-in was asked, and how make ended."""
        self.calls_file.write_text("")
        # Under `make test` our own make's flags and variables would reach the one that is tested
        inherited = {name: value for name, value in os.environ.items() if not name.startswith(("MAKE", "MFLAGS"))}
        ended = subprocess.run(
            ["make", f"PYTHON={self.python}", *arguments],
            cwd=self.folder,
            env={
                **inherited,
                "CALLS": str(self.calls_file),
                "FAIL": "",
                "OLD": "",
                "WARM_UP": "",
                "INTERRUPT": "",
                **environment,
            },
            capture_output=True,
            text=True,
        )
        return [line.rstrip() for line in self.calls_file.read_text().splitlines()], ended

    def touch(self, name: str) -> None:
        """Make a file newer than every other."""
        newest = max(path.stat().st_mtime_ns for path in self.folder.rglob("*"))
        os.utime(self.folder / name, ns=(newest + 10**9, newest + 10**9))


@pytest.fixture
def clone(tmp_path: Path) -> Clone:
    return Clone(tmp_path)


def starting(calls: list[str], prefix: str) -> list[str]:
    return [call for call in calls if call.startswith(prefix)]


def test_train_from_a_fresh_clone(clone: Clone) -> None:
    calls, ended = clone.make("train")
    assert ended.returncode == 0, ended.stderr
    assert calls[1:] == [
        "-m venv --clear .venv",
        "-m pip install -c constraints.txt -e .[zoo]",
        "-m benchmark.plan --algo cgp --env Pendulum-v1 --folder logs",
        "-m rl_zoo3.train --algo cgp --env Pendulum-v1 --seed 0 --num-threads 1 --eval-freq 250 --eval-episodes 10 "
        "--log-folder logs --progress --tensorboard-log logs/tensorboard",
        "-m benchmark.report --algo cgp --env Pendulum-v1 --folder logs --exp-id 4",
    ]


def test_train_takes_the_settings_of_a_run(clone: Clone) -> None:
    calls, _ = clone.make(
        "train", "ALGO=td3", "ENV=Ant-v5", "STEPS=60000", "SEED=2", "EVAL_FREQ=500", "LOGS=my logs",
        "PARAMS=batch_size:128 policy_loss:\"'qgp'\"", "ARGS=--save-freq 100", "THREADS=4",
    )  # fmt: skip
    assert starting(calls, "-m benchmark.plan") == [
        "-m benchmark.plan --algo td3 --env Ant-v5 --folder <my logs> --steps 60000 "
        "-- -params batch_size:128 policy_loss:'qgp' --save-freq 100"
    ]
    assert starting(calls, "-m rl_zoo3.train") == [
        "-m rl_zoo3.train --algo td3 --env Ant-v5 --seed 2 --num-threads 4 --n-timesteps 60000 --eval-freq 500 "
        "--eval-episodes 10 --log-folder <my logs> --progress --tensorboard-log <my logs/tensorboard> "
        "-params batch_size:128 policy_loss:'qgp' --save-freq 100"
    ]


@pytest.mark.parametrize(
    ("params", "expected"), [("", "learning_starts:25"), ("batch_size:8 tau:1", "learning_starts:25 batch_size:8 tau:1")]
)
def test_the_planned_warm_up_is_a_hyperparameter_of_the_run(params: str, expected: str, clone: Clone) -> None:
    calls, ended = clone.make("train", "STEPS=250", f"PARAMS={params}", "ARGS=--track", WARM_UP="learning_starts:25")
    assert ended.returncode == 0, ended.stderr
    assert starting(calls, "-m rl_zoo3.train")[0].endswith(f"--tensorboard-log logs/tensorboard -params {expected} --track")


def test_settings_are_not_taken_from_the_environment(clone: Clone) -> None:
    calls, _ = clone.make("train", ENV="/home/someone/.shrc", SEED="salt")
    assert "--env Pendulum-v1 --seed 0" in starting(calls, "-m rl_zoo3.train")[0]


@pytest.mark.parametrize("goal", ["train", "test", "help"])
def test_a_misspelt_variable_is_refused_before_anything_is_done(goal: str, clone: Clone) -> None:
    calls, ended = clone.make(goal, "STEP=2500", "SEED=1")
    assert (calls, ended.returncode) == ([], 2)
    assert "There is no variable STEP, but: ALGO ENV SEED STEPS " in ended.stderr


@pytest.mark.parametrize("given", ["CUDA_VISIBLE_DEVICES=0", "PYTEST_ADDOPTS=-x", "MAKEFLAGS=-s", "SHELL=/bin/sh"])
def test_variables_of_other_programs_are_taken(given: str, clone: Clone) -> None:
    assert clone.make("help", given)[1].returncode == 0


def test_variables_of_an_outer_make_are_taken(clone: Clone) -> None:
    assert clone.make("help", "MODE=release", MAKELEVEL="1")[1].returncode == 0


def test_failed_training_is_not_reported(clone: Clone) -> None:
    calls, ended = clone.make("train", FAIL="rl_zoo3.train")
    assert ended.returncode != 0
    assert not starting(calls, "-m benchmark.report")


@pytest.mark.parametrize("has_state", [True, False])
def test_an_interrupted_training_says_how_it_is_continued(has_state: bool, clone: Clone) -> None:
    if has_state:
        state = clone.folder / "my logs" / "cgp" / "my_space-Env-v0_4" / "state"
        state.mkdir(parents=True)
        (state / "state-000000000100.json").touch()
    calls, ended = clone.make("train", "ENV=my_space/Env-v0", "LOGS=my logs", INTERRUPT="yes")
    assert ended.returncode != 0
    assert starting(calls, "-m rl_zoo3.train")
    assert not starting(calls, "-m benchmark.report")
    assert ('make resume RUN="my logs/cgp/my_space-Env-v0_4"' in ended.stdout) == has_state


def test_resume_goes_on_with_the_named_run_and_reports_it(clone: Clone) -> None:
    run = clone.folder / "my logs/cgp/Ant-v5_2"
    run.mkdir(parents=True)
    calls, ended = clone.make("resume", "RUN=my logs/cgp/Ant-v5_2")
    assert ended.returncode == 0, ended.stderr
    assert calls[-2:] == ["-m sb3_cgp.zoo.resume <my logs/cgp/Ant-v5_2>", "-m benchmark.report --run <my logs/cgp/Ant-v5_2>"]
    calls, ended = clone.make("resume", f"RUN={run}", FAIL="sb3_cgp.zoo.resume")
    assert ended.returncode != 0
    assert not starting(calls, "-m benchmark.report")


def test_resume_without_a_run_says_how_to_name_one(clone: Clone) -> None:
    calls, ended = clone.make("resume", RUN="/var/run")
    assert ended.returncode != 0
    assert "make resume RUN=logs/cgp/Pendulum-v1_1" in ended.stderr
    # Before anything is installed, also beside another goal
    assert calls == []
    for goals in (["resume", "RUN="], ["resume", "RUN= "], ["train", "resume"], ["-j4", "resume"]):
        calls, ended = clone.make(*goals)
        assert (calls, ended.returncode) == ([], 2)
    assert "make resume RUN=logs/cgp/Pendulum-v1_1" in ended.stderr
    assert not starting(calls, "-m sb3_cgp")


def test_resume_of_a_missing_run_says_so_before_anything_is_installed(clone: Clone) -> None:
    calls, ended = clone.make("resume", "RUN=logs/cgp/Ant-v5_2")
    assert (calls, ended.returncode) == ([], 2)
    assert "There is no folder logs/cgp/Ant-v5_2" in ended.stderr


def test_every_goal_installs_its_extra_once(clone: Clone) -> None:
    goals = ("train", "sweeps", "docs", "test", "train", "test-slow", "sweeps", "docs", "resume")
    installed = [starting(clone.make(goal, "RUN=.")[0], "-m pip") for goal in goals]
    extras = [[call.partition("-e ")[2] for call in calls] for calls in installed]
    assert extras == [[".[zoo]"], [".[sweeps]"], [".[docs]"], [".[tests]"], [], [], [], [], []]


def test_lint_checks_formatting_imports_and_types_and_test_uses_every_core(clone: Clone) -> None:
    calls, ended = clone.make("test")
    assert ended.returncode == 0, ended.stderr
    expected = ("-m ruff check .", "-m black --check .", "--no-logo", "-m mypy", "-m pytest --numprocesses logical")
    assert all(starting(calls, prefix) for prefix in expected)


def test_docs_are_built_without_warnings_and_their_links_checked(clone: Clone) -> None:
    calls, ended = clone.make("docs")
    assert ended.returncode == 0, ended.stderr
    assert "--fail-on-warning" in calls[-2]
    assert calls[-1] == "docs/check_site.py build/site"
    _, ended = clone.make("docs", FAIL="docs/check_site.py")
    assert ended.returncode != 0


@pytest.mark.parametrize("goal", ["train", "test", "sweeps", "docs"])
def test_nothing_is_installed_twice(clone: Clone, goal: str) -> None:
    clone.make(goal)
    calls, ended = clone.make(goal)
    assert ended.returncode == 0, ended.stderr
    assert not starting(calls, "-m pip")
    assert not starting(calls, "-m venv")


@pytest.mark.parametrize("name", REQUIREMENTS)
def test_changed_requirements_are_installed_over_the_environment(clone: Clone, name: str) -> None:
    clone.make("lint")
    clone.touch(name)
    calls, _ = clone.make("lint")
    assert starting(calls, "-m pip") == [
        "-m pip install -c constraints.txt -e .[zoo]",
        "-m pip install -c constraints.txt -e .[tests]",
    ]
    assert not starting(calls, "-m venv")


@pytest.mark.parametrize("failing", ["-e .", "-e .[tests]"])
def test_half_made_environment_is_made_afresh(clone: Clone, failing: str) -> None:
    _, ended = clone.make("lint", FAIL=f"pip install -c constraints.txt {failing}")
    assert ended.returncode != 0
    calls, ended = clone.make("lint")
    assert ended.returncode == 0, ended.stderr
    assert starting(calls, "-m venv") == ["-m venv --clear .venv"]


def test_interrupted_change_of_requirements_is_made_afresh(clone: Clone) -> None:
    clone.make("train")
    clone.touch("setup.cfg")
    _, ended = clone.make("train", FAIL="pip install")
    assert ended.returncode != 0
    calls, _ = clone.make("train")
    assert starting(calls, "-m venv") == ["-m venv --clear .venv"]


def test_old_python_is_refused_by_name(clone: Clone) -> None:
    calls, ended = clone.make("train", OLD="yes")
    assert ended.returncode != 0
    assert f"needs Python 3.10 or newer, but {clone.python} is: Python 3.9.1" in ended.stderr
    assert not starting(calls, "-m venv")


def test_environments_of_other_packages_are_named(clone: Clone) -> None:
    calls, ended = clone.make("test-environments", "PACKAGES=panda-gym mpe2", "ARGS=--keep")
    assert ended.returncode == 0, ended.stderr
    assert calls[-2:] == [
        "-m pip install -c constraints.txt -e .[sweeps]",
        "-m benchmark.environments --packages panda-gym mpe2 --keep",
    ]
    calls, _ = clone.make("test-environments", PACKAGES="from the environment")
    assert calls[-1] == "-m benchmark.environments"


def test_help_is_the_default_and_lists_every_goal(clone: Clone) -> None:
    calls, ended = clone.make()
    assert not calls
    goals = re.findall(r"^([a-z-]+):", (clone.folder / "Makefile").read_text(), flags=re.MULTILINE)
    assert {"train", "docs", "test", "test-oldest", "dist", "release-check", "clean"} <= set(goals)
    for goal in goals:
        assert f"make {goal} " in ended.stdout
    phony = re.search(r"^\.PHONY: (.*)$", (clone.folder / "Makefile").read_text(), flags=re.MULTILINE)
    assert sorted(phony[1].split()) == sorted(goals)


def test_what_make_creates_is_ignored_by_git_and_removed_by_clean(clone: Clone) -> None:
    """Trained agents and results are ignored, too, and stay."""
    ignored = (ROOT / ".gitignore").read_text().splitlines()
    created = (".venv", ".venv-oldest", "build", "dist", ".pytest_cache", ".mypy_cache", ".ruff_cache", ".import_linter_cache")
    for name in (*created, "htmlcov", "package.egg-info", "sb3_cgp/__pycache__"):
        (clone.folder / name).mkdir(parents=True)
        pattern = f"*{Path(name).suffix}" if name.endswith(".egg-info") else Path(name).name
        assert f"{pattern}/" in ignored
    (clone.folder / ".coverage").touch()
    assert ".coverage" in ignored
    for name in ("logs", "results"):
        (clone.folder / name).mkdir()
        assert {f"{name}/", f"/{name}/"} & set(ignored)
    _, ended = clone.make("clean")
    assert ended.returncode == 0, ended.stderr
    left = {path.name for path in clone.folder.iterdir()}
    assert left == {Path(name).parts[0] for name in FILES} | {
        "logs",
        "results",
    }


def test_the_oldest_versions_have_an_environment_of_their_own(clone: Clone) -> None:
    calls, ended = clone.make("test-oldest")
    assert ended.returncode == 0, ended.stderr
    assert starting(calls, "-m venv") == ["-m venv --clear .venv-oldest"]
    assert starting(calls, "-m pip") == [
        "-m pip install -c constraints-oldest.txt -e .[zoo]",
        "-m pip install -c constraints-oldest.txt -e .[tests]",
    ]
    assert calls[-1].startswith("-m pytest")
    assert not (clone.folder / ".venv").exists()


def test_what_is_built_is_checked(clone: Clone) -> None:
    (clone.folder / "dist").mkdir()
    (clone.folder / "dist" / "sb3_cgp-0.0.9.tar.gz").touch()
    calls, ended = clone.make("dist")
    assert ended.returncode == 0, ended.stderr
    assert calls[-2:] == ["-m build --no-isolation", "-m twine check --strict dist/*"]
    assert not (clone.folder / "dist").exists()
    _, ended = clone.make("dist", FAIL="twine check")
    assert ended.returncode != 0


def test_a_release_is_checked_with_the_tag_and_the_address(clone: Clone) -> None:
    calls, _ = clone.make("release-check", "TAG=v1", "ADDRESS=https://example.org/a b")
    assert calls == [".github/check_release.py v1 --address <https://example.org/a b>"]
    assert clone.make("release-check", "TAG=v1")[0] == [".github/check_release.py v1"]


def test_clean_leaves_the_trained_models(clone: Clone) -> None:
    clone.make("train")
    (clone.folder / "logs").mkdir()
    clone.make("clean")
    assert (clone.folder / "logs").is_dir()
    assert not (clone.folder / ".venv").exists()
