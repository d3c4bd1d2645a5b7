"""The pages' examples run, the numbers on hyperparameters are those of the records, and faults of a built site are found."""

import json
import re
import runpy
import sys
from types import SimpleNamespace

import pytest
from examples import ROOT, python_examples, run_in_order
from stable_baselines3.common.logger import KVWriter, Logger

import sb3_cgp.population
import sb3_cgp.resumption
import sb3_cgp.selectors
import sb3_cgp.zoo
from sb3_cgp import CGP
from sb3_cgp.population import Population

# Those whose examples have tests of their own
ELSEWHERE = {"docs/architecture.md", "docs/population.md"}
PAGES = sorted(f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md"))
WITH_EXAMPLES = [page for page in PAGES if page not in ELSEWHERE and python_examples(page)]
RESULTS = (ROOT / "benchmark/results/sweeps/results.md").read_text()


def test_pages_have_examples():
    assert {"docs/quickstart.md", "docs/algorithm.md", "docs/robot.md", "docs/environments.md"} <= set(WITH_EXAMPLES)


@pytest.mark.parametrize("page", WITH_EXAMPLES)
def test_examples_of_a_page_run_in_order(page, monkeypatch, tmp_path):
    run_in_order(page, monkeypatch, tmp_path)


def cells(line):
    return [cell.strip() for cell in line.strip().strip("|").split("|")]


def test_figures_on_hyperparameters_are_those_of_the_sweeps():
    page = (ROOT / "docs" / "hyperparameters.md").read_text()
    rows = [cells(line) for line in page.splitlines() if re.match(r"\| [a-z ]+ [\d.a-z]+.*\(-", line)]
    recorded = [cells(line) for line in RESULTS.splitlines() if line.startswith("| Pendulum-v1 |") and "CGP-Online" in line]
    # task, settings, method, interval, mean, lowest, highest, runs, failed; of four runs the interval is the range
    recorded = {(row[1], row[3]) for row in recorded if len(row) == 9 and row[3].endswith(f"({row[5]} to {row[6]})")}
    assert len(rows) == 24
    assert [row for row in rows if tuple(row[:2]) not in recorded] == []

    low = {}
    for study in ("e3", "e6"):
        for line in (ROOT / f"benchmark/results/sweeps/{study}/runs.jsonl").read_text().splitlines():
            run = json.loads(line)
            if run["method"] == "CGP-Online":
                settings = "learning rate {learning_rate}, batch size {batch_size}".format(**run["settings"])
                low.setdefault((study, settings), []).append(run["final"] < -150)
    counts = {(settings, str(sum(runs))) for (_, settings), runs in low.items()}
    assert len(counts) == 11
    assert {(row[0], row[2]) for row in rows if len(row) == 3} == counts


class Keys(KVWriter):
    """Collects the keys of a log."""

    def __init__(self):
        self.keys = set()

    def write(self, key_values, key_excluded, step=0):
        self.keys |= key_values.keys()


def test_the_logged_keys_are_those_that_the_page_explains():
    section = (ROOT / "docs/algorithm.md").read_text().partition("## What training logs\n")[2].partition("\n## ")[0]
    keys, arguments = Keys(), dict(learning_starts=20, batch_size=8, policy_kwargs=dict(net_arch=[8]), seed=0)
    for model in (CGP("MlpPolicy", "Pendulum-v1", **arguments), Population("MlpPolicy", "Pendulum-v1", 1, **arguments)):
        model.set_logger(Logger(None, [keys]))
        # An episode, after which the log is written
        model.learn(200, log_interval=1)
    assert {key for key in keys.keys if key.startswith("train/")} == set(re.findall(r"`(train/\w+)`", section))


def test_every_public_name_is_documented_once():
    reference = "".join((ROOT / "docs" / page).read_text() for page in ("algorithm.md", "api.md"))
    documented = [name.rpartition(".")[2] for name in re.findall(r"\.\. auto(?:class|function|exception):: (\S+)", reference)]
    modules = (sb3_cgp, sb3_cgp.population, sb3_cgp.resumption, sb3_cgp.selectors, sb3_cgp.zoo)
    public = {name for module in modules for name in module.__all__} - {"__version__"}
    assert sorted(documented) == sorted(public)


def test_the_page_of_curves_is_read_at_every_build(monkeypatch):
    # Sphinx is no requirement of the tests: of the module, the extension needs a name for annotations
    pytest.importorskip("plotly")
    monkeypatch.setitem(sys.modules, "sphinx.application", SimpleNamespace(Sphinx=object))
    extension = runpy.run_path(str(ROOT / "docs" / "site_curves.py"))
    handlers = {}
    extension["setup"](SimpleNamespace(config=SimpleNamespace(html_static_path=[]), connect=handlers.__setitem__))
    (page,) = handlers["env-get-outdated"](None, None, set(), set(), set())
    assert (ROOT / f"{page}.md").read_text().count(extension["MARK"]) == 1


CHECK = runpy.run_path(str(ROOT / "docs" / "check_site.py"))["find_faults"]
GOOD = (
    '<h1 id="top">A</h1><a href="b.html#part">b</a><a href="#top">up</a><img src="i.png"><a href="https://example.org">out</a>'
)

FIGURE = '<div data-figure="f"></div><script type="application/json" id="f">{"data": [1], "layout": 1}</script>'


@pytest.fixture
def site(tmp_path):
    (tmp_path / "a.html").write_text(GOOD)
    (tmp_path / "b.html").write_text('<h1 id="part">B</h1><img src="data:image/png;base64,AA==">')
    (tmp_path / "i.png").write_bytes(b"")
    (tmp_path / "plotly.js").write_text("")
    return tmp_path


def test_a_whole_site_has_no_fault(site):
    assert list(CHECK(site)) == []
    (site / "c.html").write_text(f'<script src="plotly.js"></script>{FIGURE}')
    assert list(CHECK(site)) == []


@pytest.mark.parametrize(
    ("broken", "fault"),
    [
        ('<a href="c.html">c</a>', "a.html: c.html: no such file"),
        ('<a href="b.html#other">b</a>', "a.html: b.html#other: no such anchor"),
        ('<a href="#other">a</a>', "a.html: #other: no such anchor"),
        ('<img src="j.png">', "a.html: j.png: no such file"),
        ('<script src="https://cdn.example.org/x.js"></script>', "a.html: loads https://cdn.example.org/x.js from a network"),
        ('<link rel="stylesheet" href="//example.org/x.css">', "a.html: loads //example.org/x.css from a network"),
        ('<script src="plotly.js"></script><div data-figure="f"></div>', "a.html: f: no data"),
        (f'<script src="plotly.js"></script>{FIGURE.replace("1}", "1")}', "a.html: f: no data"),
        (f'<script src="plotly.js"></script>{FIGURE.replace("[1]", "[]")}', "a.html: f: no data"),
        (FIGURE, "a.html: loads plotly.js 0 times"),
    ],
)
def test_a_fault_of_a_site_is_named(site, broken, fault):
    (site / "a.html").write_text(GOOD + broken)
    assert list(CHECK(site)) == [fault]


def test_a_folder_without_pages_is_a_fault(tmp_path):
    assert list(CHECK(tmp_path)) == [f"{tmp_path}: no page"]


@pytest.fixture(scope="module")
def diagrams():
    return runpy.run_path(str(ROOT / "docs" / "draw_diagrams.py"))


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("sequenceDiagram\n a --> b", "must be 'flowchart BT'"),
        ("flowchart LR\n a ==> b", "must be name"),
        ("flowchart BT\n a --> b\n b --> a", "are a circle"),
    ],
)
def test_a_diagram_that_cannot_be_drawn_is_named(text, fault, diagrams):
    with pytest.raises(Exception, match=fault):
        diagrams["svg"](text)


def test_boxes_of_a_diagram_stand_in_the_order_of_the_arrows_without_overlap(diagrams):
    chart = diagrams["parse"]('flowchart BT\n a["<b>A</b><br>first & last --> x"] --> b & c --> d\n a --> d')
    assert chart.arrows == [("a", "b"), ("a", "c"), ("b", "d"), ("c", "d"), ("a", "d")]
    width, height = diagrams["place"](chart)
    boxes = chart.boxes
    assert (boxes["a"].lines, boxes["a"].bold) == (["A", "first & last --> x"], 1)
    assert boxes["a"].y > boxes["b"].y == boxes["c"].y > boxes["d"].y
    assert boxes["b"].x + boxes["b"].width / 2 < boxes["c"].x - boxes["c"].width / 2
    for box in boxes.values():
        assert 0 <= box.x - box.width / 2 < box.x + box.width / 2 <= width
        assert -1e-9 <= box.y - box.height / 2 < box.y + box.height / 2 <= height + 1e-9


def test_a_diagram_shows_every_name_and_every_arrow(diagrams):
    drawn = diagrams["svg"]('flowchart LR\n a["<i>"] --> b --> c\n c -. "back & forth" .-> a')
    assert drawn.count("<rect") == 3
    assert "&lt;i&gt;" in drawn
    assert "back &amp; forth" in drawn
    assert drawn.partition('class="arrow"')[2].count("<path") == 3


def test_diagrams_of_all_pages_can_be_drawn(diagrams):
    blocks = [block for page in PAGES for block in re.findall(r"```mermaid\n(.*?)```", (ROOT / page).read_text(), re.DOTALL)]
    assert blocks
    for block in blocks:
        assert diagrams["svg"](block).startswith('<div class="wide"><svg')
