"""Sphinx's configuration. The source folder is the repository's root, so that links between all pages hold on GitHub, too."""

from importlib.metadata import version as installed_version

from pygments.lexers.special import TextLexer
from sphinx.application import Sphinx

project = "sb3-cgp"
author = "The sb3-cgp authors"
copyright = author
version = release = installed_version("sb3-cgp")

root_doc = "docs/index"
include_patterns = ["README.md", "CHANGELOG.md", "CONTRIBUTING.md", "docs/**", "benchmark/results/**"]
exclude_patterns = [".*", "build", "dist", "logs", "venv"]

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx_copybutton"]
myst_enable_extensions = ["deflist"]
# Links to headings, as GitHub has them
myst_heading_anchors = 3

autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"
autodoc_preserve_defaults = True
python_use_unqualified_type_names = True

html_theme = "furo"
html_title = "sb3-cgp"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_additional_pages = {"index": "redirect.html"}
templates_path = ["templates"]
html_copy_source = False
pygments_style, pygments_dark_style = "tango", "monokai"


def setup(app: Sphinx) -> None:
    """Show diagrams in Mermaid's language, which GitHub draws, as text."""
    app.add_lexer("mermaid", TextLexer)
