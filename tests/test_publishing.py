"""What is published: the description on PyPI, the oldest versions admitted, the checks of the workflow and of pre-commit."""

import configparser
import re
import runpy
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version
from readme_renderer import markdown
from setuptools._distutils.filelist import FileList

ROOT = Path(__file__).parents[1]
ADDRESS = "https://example.org/someone/sb3-cgp"
BACKEND = runpy.run_path(str(ROOT / "_build_backend.py"))
DESCRIBE = BACKEND["describe"]
FIND_FAULTS = runpy.run_path(str(ROOT / ".github" / "check_release.py"))["find_faults"]


class Links(HTMLParser):
    """The addresses that a page links to and loads."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.linked: list[str] = []
        self.loaded: list[str] = []
        self.feed(html)

    def handle_starttag(self, tag, attrs):
        addresses = dict(attrs)
        self.linked += [addresses["href"]] if "href" in addresses else []
        self.loaded += [addresses["src"]] if "src" in addresses else []


def test_the_description_on_pypi_has_no_relative_link_or_image():
    readme = (ROOT / "README.md").read_text()
    page = Links(markdown.render(DESCRIBE(readme, ADDRESS, "1.2.3")))
    assert len(page.linked) > 20
    assert page.loaded
    assert [address for address in page.linked + page.loaded if not address.startswith(("https://", "#"))] == []
    for address in page.linked + page.loaded:
        if address.startswith(ADDRESS):
            kind, tag, path = address.removeprefix(f"{ADDRESS}/").split("/", 2)
            assert (kind, tag) == ("raw" if address in page.loaded else "blob", "v1.2.3")
            assert (ROOT / path.partition("#")[0]).exists()


@pytest.mark.parametrize(
    ("markup", "expected"),
    [
        ("[a](docs/a.md#b)", f"[a]({ADDRESS}/blob/v1/docs/a.md#b)"),
        ("[`a`](./docs/a.md)", f"[`a`]({ADDRESS}/blob/v1/docs/a.md)"),
        ("![a](b/c.PNG)", f"![a]({ADDRESS}/raw/v1/b/c.PNG)"),
        ("[![a](c.svg)](LICENSE)", f"[![a]({ADDRESS}/raw/v1/c.svg)]({ADDRESS}/blob/v1/LICENSE)"),
        ('<img alt="a" src="b.gif">', f'<img alt="a" src="{ADDRESS}/raw/v1/b.gif">'),
        ("[a]\n\n[a]: docs/a.md\n", f"[a]\n\n[a]: {ADDRESS}/blob/v1/docs/a.md\n"),
        *[(text, text) for text in ("[a](https://a.org)", "[a](#a)", "[a](mailto:a@b.org)", "`a[0](b)`", "```\na[0](b)\n```")],
    ],
)
def test_relative_targets_alone_are_made_absolute(markup, expected):
    assert DESCRIBE(markup, ADDRESS, "1") == expected
    assert DESCRIBE(markup, "", "1") == markup


def test_links_beside_the_description_need_an_address():
    assert BACKEND["link_to"]("", "1") == {}
    assert all(link.startswith(ADDRESS) for link in BACKEND["link_to"](ADDRESS, "1").values())


@pytest.mark.parametrize("address", ["", ADDRESS])
def test_setup_takes_the_description_and_the_links_from_the_address(address, tmp_path):
    """setuptools itself writes the metadata."""
    for name in ("setup.py", "pyproject.toml", "_build_backend.py", "README.md", "LICENSE"):
        (tmp_path / name).write_text((ROOT / name).read_text())
    settings = re.sub(r"^address =.*$", f"address = {address}", (ROOT / "setup.cfg").read_text(), flags=re.MULTILINE)
    (tmp_path / "setup.cfg").write_text(settings)
    for folder in ("sb3_cgp", "metadata"):
        (tmp_path / folder).mkdir()
    (tmp_path / "sb3_cgp" / "version.txt").write_text("1.2.3\n")
    code = "import _build_backend; _build_backend.prepare_metadata_for_build_wheel('metadata')"
    ended = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    metadata = next(tmp_path.glob("metadata/*.dist-info/METADATA")).read_text()
    head, _, description = metadata.partition("\n\n")
    assert "Version: 1.2.3" in head
    assert f"Project-URL: Source, {address}\n" in head if address else "URL" not in head
    assert description.strip() == DESCRIBE((ROOT / "README.md").read_text(), address, "1.2.3").strip()


def requirements() -> list[Requirement]:
    """Every requirement of the package and its extras, but for its own extras."""
    settings = configparser.ConfigParser()
    settings.read(ROOT / "setup.cfg")
    texts = [settings["options"]["install_requires"], *settings["options.extras_require"].values()]
    lines = [line.strip() for text in texts for line in text.splitlines()]
    found = [Requirement(line) for line in lines if line and not line.startswith("#")]
    return [requirement for requirement in found if requirement.name != "sb3-cgp"]


def pins(name: str) -> dict[str, str]:
    """The versions of a file of constraints, for the Python that runs the tests."""
    lines = [line for line in (ROOT / name).read_text().splitlines() if line and not line.startswith("#")]
    found = [Requirement(line) for line in lines]
    admitted = [each for each in found if each.marker is None or each.marker.evaluate()]
    return {canonicalize_name(each.name): str(each.specifier).removeprefix("==") for each in admitted}


def test_every_requirement_has_a_lower_bound_which_is_the_oldest_version_tested():
    oldest = pins("constraints-oldest.txt")
    for requirement in requirements():
        (bound,) = (Version(each.version) for each in requirement.specifier if each.operator in (">=", "~="))
        pinned = Version(oldest[canonicalize_name(requirement.name)])
        assert requirement.specifier.contains(pinned), requirement
        # Stubs have a date behind the version
        assert pinned.release[: len(bound.release)] == bound.release, requirement
        assert not any(pinned.release[len(bound.release) : 3]), requirement


def test_both_files_of_constraints_pin_every_requirement():
    known, oldest = pins("constraints.txt"), pins("constraints-oldest.txt")
    for requirement in requirements():
        name = canonicalize_name(requirement.name)
        assert requirement.specifier.contains(known[name]), requirement
        assert Version(oldest[name]) <= Version(known[name]), requirement


GOALS = re.findall(r"^([a-z-]+):.*## ", (ROOT / "Makefile").read_text(), flags=re.MULTILINE)
WORKFLOW = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text())


def test_every_check_of_the_workflow_is_a_goal_of_the_makefile():
    matrix = WORKFLOW["jobs"]["check"]["strategy"]["matrix"]["include"]
    checks = {(row["python"], row["goal"]) for row in matrix}
    commands = [step["run"] for job in WORKFLOW["jobs"].values() for step in job["steps"] if "run" in step]
    assert {goal for _, goal in checks} <= set(GOALS)
    assert sorted(command.split()[1] for command in commands) == ['"$GOAL"', "release-check"]
    assert WORKFLOW["jobs"]["check"]["env"]["GOAL"] == "${{ matrix.goal }}"
    # All of .ci/run, and the quick tests on each version of Python that setup.cfg names
    in_house = re.findall(r"^make ([a-z-]+)$", (ROOT / ".ci" / "run").read_text(), flags=re.MULTILINE)
    assert len(in_house) >= 4
    assert set(in_house) | {"lint", "test-oldest"} <= {goal for _, goal in checks}
    supported = re.findall(r"Python :: (3\.\d+)", (ROOT / "setup.cfg").read_text())
    assert {python for python, goal in checks if goal in ("test", "test-quick")} == set(supported)


def test_a_release_waits_for_every_check_and_has_the_right_to_publish_alone():
    release = WORKFLOW["jobs"]["release"]
    assert release["needs"] == "check"
    assert release["if"] == "github.ref_type == 'tag'"
    assert release["permissions"] == {"id-token": "write"}
    assert WORKFLOW["permissions"] == {"contents": "read"}
    assert not any("run" in step for step in release["steps"])


@pytest.fixture
def repository(tmp_path):
    """A repository whose version 1.2.3 can be released."""
    (tmp_path / "sb3_cgp").mkdir()
    (tmp_path / "sb3_cgp" / "version.txt").write_text("1.2.3\n")
    (tmp_path / "CHANGELOG.md").write_text("# Changelog\n\n## [1.2.3] - 2026-12-01\n")
    (tmp_path / "setup.cfg").write_text(f"[repository]\naddress = {ADDRESS}\n")
    return tmp_path


def test_a_repository_in_order_can_be_released(repository):
    assert list(FIND_FAULTS(repository, "v1.2.3", ADDRESS)) == []


@pytest.mark.parametrize(
    ("tag", "address", "file", "text", "fault"),
    [
        ("1.2.3", None, None, "", r"tag is '1.2.3', .* whose tag is 'v1.2.3'"),
        ("v1.2.4", None, None, "", r"tag is 'v1.2.4', and sb3_cgp/version.txt has 1.2.3"),
        ("v1.2.3", None, "CHANGELOG.md", "## [Unreleased]: 1.2.3\n", r"CHANGELOG.md has no heading '## \[1.2.3\] - '"),
        ("v1.2.3", None, "setup.cfg", "[repository]\naddress =\n", r"has no address: README's links"),
        ("v1.2.3", ADDRESS + "-fork", None, "", r"is https://example.org/someone/sb3-cgp, and .* in \S+-fork$"),
    ],
)
def test_what_stands_against_a_release_is_named(tag, address, file, text, fault, repository):
    if file:
        (repository / file).write_text(text)
    (found,) = FIND_FAULTS(repository, tag, address)
    assert re.search(fault, found)


def test_the_hooks_before_a_commit_are_the_linters_of_make_lint():
    """They run from .venv, so that there is one place for their versions: constraints.txt."""
    config = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())
    assert [repo["repo"] for repo in config["repos"]] == ["local"]
    hooks = {hook["id"]: hook["entry"] for hook in config["repos"][0]["hooks"]}
    lint = re.search(r"^lint:.*\n((?:\t.*\n)+)", (ROOT / "Makefile").read_text(), flags=re.MULTILINE)[1]
    steps = [line.strip() for line in lint.splitlines()]
    commands = [step.replace("$(IN_VENV)", ".venv/bin/python").replace("$(VENV)", ".venv") for step in steps]
    # The files are named by pre-commit
    whole = [command.removesuffix(" .") for command in commands]
    assert [entry.replace(" --force-exclude", "") for entry in hooks.values()] == whole
    assert {"ruff", "black", "import-linter", "mypy"} == set(hooks) <= set(pins("constraints.txt"))


def test_the_documents_of_the_repository_link_to_files_and_goals_that_exist():
    contributing = (ROOT / "CONTRIBUTING.md").read_text()
    template = (ROOT / ".github" / "pull_request_template.md").read_text()
    forms = {path.name: path.read_text() for path in (ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml")}
    assert set(forms) == {"bug.yml", "question.yml", "feature.yml", "config.yml"}
    linked = re.findall(r"\]\(([^)#]+)[^)]*\)", contributing)
    linked += [path for text in forms.values() for path in re.findall(r"\.\./blob/main/([^)]+)\)", text)]
    assert len(linked) > 8
    assert [path for path in linked if not (ROOT / path).exists()] == []
    named = re.findall(r"\bmake ([a-z-]+)", contributing + template + "".join(forms.values()))
    assert {"test", "docs", "format", "release-check"} <= set(named) <= set(GOALS)


ANSWERS = (ROOT / "docs" / "answers.md").read_text()


def test_every_answer_names_an_issue_of_its_project_and_a_page_here():
    repositories = {"SB3": "DLR-RM/stable-baselines3", "rl_zoo3": "DLR-RM/rl-baselines3-zoo", "SBX": "araffin/sbx"}
    links = re.findall(r"\[(?:(SB3|rl_zoo3|SBX)\s)?#(\d+)\]\((https://[^)]+)\)", ANSWERS)
    assert len(links) > 20
    project = None
    for name, number, address in links:
        project = name or project
        assert re.fullmatch(rf"https://github.com/{repositories[project]}/(issues|pull)/{number}", address)
    for answer in re.findall(r"^\*\*.*?(?=^\*\*|^## |\Z)", ANSWERS, flags=re.MULTILINE | re.DOTALL):
        assert re.search(r"\]\([a-z_]+\.md[^)]*\)", answer), answer


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="only a clone knows the tracked files")
def test_the_source_distribution_has_every_file_but_results():
    command = ["git", "ls-files", "benchmark", "docs", "hyperparams", "tests"]
    tracked = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout.split()
    files = FileList()
    files.set_allfiles(tracked)
    for line in (ROOT / "MANIFEST.in").read_text().splitlines():
        files.process_template_line(line)
    assert sorted(name for name in tracked if not name.startswith("benchmark/results/")) == sorted({*tracked} & {*files.files})
