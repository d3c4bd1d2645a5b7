"""The README is short, its example runs as it stands, shortened, and its files exist."""

import json
import re

import pytest
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


@pytest.mark.parametrize(
    ("row", "record", "methods"),
    [
        ("minutes for 100,000 steps, one CPU thread", "runtime_light_zen5", ["TD3", "CGP-Light", "CGP-2"]),
        ("[the same on an NVIDIA H100](docs/speed.md#on-a-gpu)", "runtime_gpu", ["TD3", None, "CGP-2"]),
    ],
)
def test_minutes_are_rounded_once_from_the_record(row, record, methods):
    measured = json.loads((ROOT / "benchmark" / "results" / record / "runtime.json").read_text())["methods"]
    (cells,) = (line.split(" | ")[1:] for line in README.splitlines() if line.startswith(f"| {row} | "))
    for cell, method in zip(cells, methods, strict=True):
        text = cell.removesuffix(" |")
        if method is not None:
            minutes = measured[method]["train"]["seconds"]["median"] * 100 / 60
            assert text == f"{minutes:.{len(text.partition('.')[2])}f}"
