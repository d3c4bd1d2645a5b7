"""The page on other packages' environments, and their declarations."""

import json
from dataclasses import asdict
from pathlib import Path

import pytest
from compatibility_records import WRITTEN, rows_of

from benchmark import environments
from benchmark.compatibility import check
from benchmark.compatibility.package_types import Environment, Learning, Package, made
from benchmark.compatibility.packages import PACKAGES
from benchmark.compatibility.page import page


def record_of(found, load_average):
    """The record of a package with one environment."""
    return {
        "package": "works",
        "installation": {"pins": "all", "seconds": 1.0},
        "environments": {"Works-v0": found},
        "versions": {"works": "1.2"},
        "other_versions": {},
        "python": "3.11.7",
        "commit": "abc",
        "machine": {"cpu": "A processor", "cores": 2},
        "load_average": load_average,
    }


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
    text = page({"works": record_of(found, load_average=3.4)})
    cells = ["differs", "yes (0e+00)", "80 (12,346)", "-49.5 → -1.5; 0 → 19 of 20 (3,000 steps)"]
    assert rows_of(text)["works: Works-v0"][2:] == cells
    assert rows_of(text)["works"] == ['`"works<2"`', "[code](#works)", "works 1.2"]
    for line in (
        "- A note.",
        "Tested on A processor, 2 cores, with Python 3.11.7. Versions are those of `constraints.txt`, unless the package's "
        "section says otherwise.",
        "The machine also ran other programs: steps/s may be too low for works.",
        "- Two trainings with one seed differ: the environment does not repeat itself.",
    ):
        assert line in text.splitlines()


@pytest.mark.parametrize(
    ("errors", "trains", "exports"),
    [
        ({"predicts": "AssertionError"}, "yes, but: predicts", "–"),
        ({"exports": "ZeroDivisionError"}, "yes", "no"),
        # Interrupted
        ({}, "yes", "–"),
    ],
)
def test_a_page_says_no_of_an_export_that_failed_and_not_of_one_that_was_not_tried(errors, trains, exports, monkeypatch):
    package = Package("works", ("works",), ("works",), (Environment("Works-v0", "env = 1"),))
    monkeypatch.setattr("benchmark.compatibility.page.PACKAGES", (package,))
    found = {name: value for name, value in WRITTEN.items() if name != "export_difference"}
    found |= {"errors": {"whole": errors}, "resumes": "bit for bit"}
    cells = rows_of(page({"works": record_of(found, load_average=0.0)}))["works: Works-v0"]
    assert (cells[1], cells[3]) == (trains, exports)


@pytest.mark.parametrize(
    ("arguments", "imports", "section"),
    [
        (dict(imported="works"), "`works`", None),
        (dict(replayed=True), "–", None),
        (dict(imported="works", arguments="n_envs=2"), "`works`", ['env = make_vec_env("Works-v0", n_envs=2)']),
    ],
)
def test_only_code_with_arguments_of_its_own_is_shown(arguments, imports, section, monkeypatch):
    package = Package("works", ("works",), ("works",), (Environment("Works-v0", made("Works-v0", **arguments)),))
    monkeypatch.setattr("benchmark.compatibility.page.PACKAGES", (package,))
    record = {"installation": {"pins": "all"}, "environments": {}, "versions": {}}
    text = page({"works": record})
    assert rows_of(text)["works"][1] == imports
    _, heading, rest = text.partition("## works\n")
    assert bool(heading) == bool(section)
    assert rest.partition("```py\n")[2].partition("\n```")[0].splitlines() == (section or [])


@pytest.mark.usefixtures("in_tmp_path")
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
