"""The notebooks of the site: their cells run, and print the returns that they name. `make docs` executes them as notebooks."""

import functools
import re
import runpy
import statistics

import matplotlib.pyplot as plt
import pytest
import yaml
from examples import ROOT, STEPS, shortened
from learning import RANDOM, SWUNG_UP
from stable_baselines3.common.callbacks import EvalCallback

FOLDER = ROOT / "docs" / "notebooks"
NOTEBOOKS = sorted(path.name for path in FOLDER.glob("*.md"))
CELLS = re.compile(r"^```\{code-cell\}\n(.*?)^```$", flags=re.DOTALL | re.MULTILINE)


def run(name, monkeypatch, folder, seed=0):
    """Run the cells of a notebook in a folder, with another seed than 0 if asked, and return the names that they define."""
    monkeypatch.chdir(folder)
    plt.switch_backend("agg")
    names = {"__name__": "__main__"}
    text = (FOLDER / name).read_text().replace("seed=0)", f"seed={seed})")
    for number, cell in enumerate(CELLS.findall(text)):
        exec(compile(cell, f"{name}, cell {number}", "exec"), names)
    plt.close("all")
    return names


def test_there_are_notebooks_and_each_cell_is_found():
    assert NOTEBOOKS == ["own_environment.md", "quickstart.md", "stability.md"]
    for name in NOTEBOOKS:
        text = (FOLDER / name).read_text()
        assert len(CELLS.findall(text)) == text.count("{code-cell}") > 4


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_is_one_for_jupyter_and_for_the_site(name):
    text = (FOLDER / name).read_text()
    front_matter = yaml.safe_load(text.split("---")[1])
    assert front_matter["file_format"] == "mystnb"
    assert front_matter["kernelspec"]["name"] == "python3"
    assert front_matter["jupytext"]["text_representation"] == {"extension": ".md", "format_name": "myst"}
    assert f"{{nb-download}}`{name.replace('.md', '.ipynb')}`" in text
    assert f"notebooks/{name.removesuffix('.md')}\n" in (ROOT / "docs" / "index.md").read_text()


def test_the_site_executes_notebooks_and_fails_with_them():
    pytest.importorskip("sphinx")
    conf = runpy.run_path(str(ROOT / "docs" / "conf.py"))
    assert "myst_nb" in conf["extensions"]
    assert (conf["nb_execution_mode"], conf["nb_execution_raise_on_error"]) == ("force", True)


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_cells_run(name, monkeypatch, tmp_path):
    shortened(monkeypatch)
    construct = EvalCallback.__init__
    often = functools.partialmethod(lambda *args, **kwargs: construct(*args, **kwargs | {"eval_freq": STEPS // 2}))
    monkeypatch.setattr(EvalCallback, "__init__", often)
    run(name, monkeypatch, tmp_path)


def printed_return(name, text):
    """The mean of a line such as ``regulator: return -0.50 ± 0.48``."""
    (found,) = re.findall(rf"^ *{name}return (-\d+(?:\.\d+)?) ± ", text, flags=re.MULTILINE)
    return float(found)


@pytest.mark.slow
def test_the_quickstart_learns(monkeypatch, tmp_path, capsys):
    returns, kept = [], []
    for seed in range(3):
        assert run("quickstart.md", monkeypatch, tmp_path, seed)["model"].seed == seed
        text = capsys.readouterr().out
        returns.append(printed_return("", text))
        # What the actor keeps of CEM's gain over random actions
        kept.append((printed_return("actor: ", text) - RANDOM) / (printed_return("cem: ", text) - RANDOM))
    assert SWUNG_UP <= statistics.median(returns) < -100
    # One of five actors keeps less: the notebook says so
    assert 0.95 < statistics.median(kept) < 1.05


@pytest.mark.slow
def test_both_selectors_come_close_to_the_best_policy(monkeypatch, tmp_path, capsys):
    run("own_environment.md", monkeypatch, tmp_path)
    text = capsys.readouterr().out
    best = printed_return("regulator: ", text)
    assert best > -0.6
    assert printed_return("random actions: ", text) < 20 * best
    for name in ("CGP with CEM: ", "CGP with a grid: "):
        assert best - 0.5 < printed_return(name, text) < best + 0.1
