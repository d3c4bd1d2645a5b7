"""A Sphinx extension: Mermaid's flowcharts are drawn within the page."""

from docutils import nodes
from draw_diagrams import svg
from sphinx.application import Sphinx


def draw_all(app: Sphinx, doctree: nodes.document) -> None:
    """
    Put drawings in the place of Mermaid's texts.

    :param app: Sphinx
    :param doctree: a page that has been read, which is changed
    """
    for block in list(doctree.findall(nodes.literal_block)):
        if block.get("language") == "mermaid":
            block.replace_self(nodes.raw("", svg(block.astext()), format="html"))


def setup(app: Sphinx) -> dict[str, bool]:
    """
    Register the extension.

    :param app: Sphinx
    :return: what Sphinx may do with several processes
    """
    app.connect("doctree-read", draw_all)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
