"""Sphinx's configuration. The source folder is the repository's root, so that links between all pages hold on GitHub, too."""

import sys
from importlib.metadata import version as installed_version
from pathlib import Path

# This folder's own extensions, and benchmark/, which is not installed
sys.path += [str(Path(__file__).parent), str(Path(__file__).parent.parent)]

project = "sb3-cgp"
author = "The sb3-cgp authors"
copyright = author
version = release = installed_version("sb3-cgp")

root_doc = "docs/index"
include_patterns = ["README.md", "CHANGELOG.md", "CONTRIBUTING.md", "docs/**", "benchmark/results/**"]
exclude_patterns = [".*", "build", "dist", "logs", "venv"]

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx_copybutton", "site_curves", "site_diagrams"]
myst_enable_extensions = ["deflist"]
# Links to headings, as GitHub has them
myst_heading_anchors = 3

# The notebooks are executed at every build. They write files, into a temporary folder.
nb_execution_mode = "force"
nb_execution_in_temp = True
nb_execution_timeout = -1
nb_execution_raise_on_error = True
nb_merge_streams = True

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
