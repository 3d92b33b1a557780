"""Sphinx's configuration, for tools/docs_site.py (make docs)."""

import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "src"))  # the reference comes from this source tree; the core is not loaded

project = "MeshSplats"
author = "The MeshSplats authors"
root_doc = "index"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]

myst_heading_anchors = 4  # as GitHub makes them
autodoc_member_order = "bysource"
autodoc_mock_imports = ["torch"]
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
napoleon_numpy_docstring = False
add_module_names = False
python_maximum_signature_line_length = 100
python_use_unqualified_type_names = True
toc_object_entries_show_parents = "hide"

html_theme = "furo"
html_title = "MeshSplats"
html_copy_source = False
html_show_copyright = False
html_theme_options = {"navigation_with_keys": True}
pygments_style = "friendly"
pygments_dark_style = "monokai"


# Napoleon takes what stands before the first colon of an attribute's docstring for its type. Ours have their
# types in the code, so docstrings of attributes without sections stay as they are.
_plain: dict[str, list[str]] = {}


def _remember(app, what, name, obj, options, lines):
    sections = [line for line in lines if re.match(r"(Args|Returns|Raises|Yields):$", line)]
    if what in ("attribute", "data", "property") and not sections:
        _plain[name] = list(lines)


def _restore(app, what, name, obj, options, lines):
    lines[:] = _plain.pop(name, lines)


def setup(app):
    app.connect("autodoc-process-docstring", _remember, priority=400)  # napoleon's is 500
    app.connect("autodoc-process-docstring", _restore, priority=600)
