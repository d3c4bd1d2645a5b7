"""The README is short, its example runs as it stands, shortened, and its files exist."""

import re

from examples import ROOT, python_examples, run_in_order

README = (ROOT / "README.md").read_text()


def test_readme_is_read_in_a_minute():
    assert len(README.splitlines()) <= 150
    assert len(python_examples("README.md")) >= 1


def test_readme_example_runs(monkeypatch, tmp_path):
    run_in_order("README.md", monkeypatch, tmp_path)


def test_every_file_that_the_readme_links_to_exists():
    linked = [link.partition("#")[0] for link in re.findall(r"\]\(([^)]+)\)", README) if "://" not in link]
    assert len(linked) > 20
    assert [link for link in linked if not (ROOT / link).exists()] == []
