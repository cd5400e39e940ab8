"""The site: ``python -m sphinx -W --keep-going docs docs/_build/html``, then open docs/_build/html/index.html.

The pages are plain Markdown that reads well without the site.  Nothing is fetched from elsewhere, neither by the build
nor by a browser, and search works from the files themselves.
"""

import re
import sys
from pathlib import Path

from sphinx.application import Sphinx

sys.path.insert(0, str(Path(__file__).parent))  # for pictures.py

project = "linksweep"
author = "The linksweep developers"
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_click",
    "sphinx_copybutton",
    "pictures",
]
root_doc = "index"
exclude_patterns = ["_build"]
templates_path: list[str] = []

myst_heading_anchors = 3  # links to headings are those of GitHub
nitpicky = True
# Public names must lead somewhere; types of NumPy, xarray ... are documented elsewhere, inner ones nowhere.
nitpick_ignore_regex = [("py:.*", r"(?!linksweep\.\w+$).*")]
smartquotes = False  # two hyphens are those of an option
default_role = "code"  # single backticks in docstrings

autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
maximum_signature_line_length = 88
python_use_unqualified_type_names = True

html_theme = "furo"
html_title = "linksweep"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_js_files = [("site.js", {"defer": "defer"})]
html_show_copyright = False
html_copy_source = False
html_show_search_summary = False  # it is fetched, which browsers refuse for files
html_show_sphinx = False
copybutton_exclude = ".linenos, .gp, .go"


def navigation(_app: Sphinx, page: str, source: list[str]) -> None:
    """Make the sidebar of the lists of index.md: a heading of the second level is a group, its links are the pages."""
    if page != root_doc:
        return
    for title, pages in re.findall(r"^## ([^\n]+)\n(.*?)(?=^## |\Z)", source[0], flags=re.MULTILINE | re.DOTALL):
        names = "\n".join(re.findall(r"\]\(([\w-]+)\.md\)", pages))
        source[0] += f"\n```{{toctree}}\n:hidden:\n:caption: {title}\n\n{names}\n```\n"


def examples(_app: Sphinx, _context: object, lines: list[str]) -> None:
    """Show the examples of a command's help, which come as line blocks, as code."""
    code = [re.sub(r"^\| ?", "   ", line) if line.startswith("|") else line for line in lines]
    starts = [i for i, line in enumerate(lines) if line.startswith("|") and not lines[i - 1].startswith("|")]
    for start in reversed(starts):
        code[start:start] = [".. code-block:: text", ""]
    lines[:] = code


def no_default(_app: Sphinx, _context: object, lines: list[str]) -> None:
    """Leave out the default of an option without one, for which Click has a mark of its own, or an empty text."""
    lines[:] = [line for line in lines if not re.search(r":default: ``(Sentinel\.UNSET|'')``", line)]


def setup(app: Sphinx) -> None:
    app.connect("source-read", navigation)
    app.connect("sphinx-click-process-description", examples)
    app.connect("sphinx-click-process-options", no_default)
