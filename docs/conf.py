"""How the documentation is built: sphinx-build -W -n -b html docs docs/_build."""

import sys
from importlib.metadata import version as installed
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "_ext"))

project = "greybox-marine"
author = "The greybox-marine authors"
copyright = author
version = release = installed("greybox-marine")

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "numpydoc",
    "benchmark_table",
    "option_tables",
    "public_names",
    "sessions",
]
exclude_patterns = ["_build", "_ext"]
# single backticks in docstrings are names of code
default_role = "code"
smartquotes = False

myst_enable_extensions = ["colon_fence", "deflist"]
# headings down to this level can be linked to
myst_heading_anchors = 4
# types stand in the Parameters of each docstring
autodoc_typehints = "none"
autodoc_member_order = "bysource"
numpydoc_show_class_members = False
numpydoc_class_members_toctree = False

linkcheck_timeout = 10
linkcheck_retries = 2
linkcheck_anchors = False

html_theme = "furo"
html_title = f"greybox-marine {release}"
html_static_path = ["_static"]
html_css_files = ["manual.css"]
html_copy_source = False
html_show_sphinx = False


def keep_matches(app, name, source):
    """Drop the patterns of the contents that no page matches."""
    if name == "index":
        lines = source[0].splitlines()
        folder = Path(__file__).parent
        kept = [x for x in lines if not x.endswith("*") or any(folder.glob(f"{x}.md"))]
        source[0] = "\n".join(kept)


def setup(app):
    """Connect what changes sources as they are read."""
    app.connect("source-read", keep_matches)
