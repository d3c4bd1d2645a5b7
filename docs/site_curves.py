"""A Sphinx extension: the figures of the page curves.md, from the committed records, and plotly.js as one file there."""

import json
from pathlib import Path

import plotly
from sphinx.application import Sphinx

from benchmark.reporting.figures import study_folders
from benchmark.reporting.interactive import figure
from benchmark.reporting.scores import Study, read_study

PAGE = "docs/curves"
# What stands in their place where the page is read without the site
MARK = "The figures are drawn when the site is built, by `make docs`."
SWEEPS = Path("benchmark/results/sweeps")
PLOTLY = Path(plotly.__file__).parent / "package_data" / "plotly.min.js"


def figure_in_words(study: Study, task: str, name: str) -> str:
    """
    Return a section with a figure, in MyST's Markdown: its data as JSON, which curves.js draws.

    :param study: the study, without axes
    :param task: the task
    :param name: the id of the element that holds the data, which no other figure of the page has
    :return: the section
    """
    ended, planned = sum(record.task == task for record in study.records), study.facts["runs_planned"]
    planned //= len({*study.facts["tasks"]})
    so_far = "" if ended >= planned else f" **{ended} of {planned} planned runs so far.**"
    data = json.dumps(figure(study, task), separators=(",", ":")).replace("</", "<\\/")
    html = (
        f'<div class="curves" data-figure="{name}"><noscript>The figure needs JavaScript.</noscript></div>\n'
        f'<script type="application/json" id="{name}">{data}</script>'
    )
    about = f"Study {study.name}: {study.facts['steps']:,} steps, seeds {', '.join(map(str, study.facts['seeds']))}.{so_far}"
    return f"## {task}\n\n{about}\n\n```{{raw}} html\n{html}\n```"


def outdated_pages(app: Sphinx, *args: object) -> list[str]:
    """
    Name the page as one to be read at every build.

    Sphinx compares times of single files. A new study is none that an earlier build has read, and the figures depend on
    ``benchmark/``, too.

    :param app: Sphinx
    :param args: what else Sphinx tells of the pages that have changed
    :return: the page
    """
    return [PAGE]


def fill(app: Sphinx, docname: str, source: list[str]) -> None:
    """
    Put the figures and the links to the records into the page.

    :param app: Sphinx
    :param docname: the page that is being read
    :param source: its text, as the only element, which is replaced
    :raises ValueError: if the page has no place for the figures
    """
    if docname != PAGE:
        return
    studies = [read_study(folder) for folder in study_folders(Path(app.srcdir) / SWEEPS)]
    learning = [(study, task) for study in studies if not study.axes for task in study.tasks]
    figures = [figure_in_words(study, task, f"figure-{number}") for number, (study, task) in enumerate(learning)]
    records = "\n".join(
        f"- {study.name}, {study.facts['title']}: [runs.jsonl](../{SWEEPS}/{study.name}/runs.jsonl), "
        f"[study.json](../{SWEEPS}/{study.name}/study.json)"
        for study in studies
    )
    if MARK not in source[0]:
        raise ValueError(f"{PAGE}.md has no place for the figures: {MARK!r}")
    source[0] = source[0].replace(MARK, "\n\n".join(figures)) + f"\n{records}\n"


def add_scripts(app: Sphinx, pagename: str, *args: object) -> None:
    """
    Load plotly.js on this page alone.

    :param app: Sphinx
    :param pagename: the page that is being written
    :param args: what else Sphinx tells of the page
    """
    if pagename == PAGE:
        app.add_js_file(PLOTLY.name, loading_method="defer")
        app.add_js_file("curves.js", loading_method="defer")


def setup(app: Sphinx) -> dict[str, bool]:
    """
    Register the extension.

    :param app: Sphinx
    :return: what Sphinx may do with several processes
    """
    app.config.html_static_path.append(str(PLOTLY))
    app.connect("env-get-outdated", outdated_pages)
    app.connect("source-read", fill)
    app.connect("html-page-context", add_scripts)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
