"""How Sphinx builds the site: `make docs`."""

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tools"), str(ROOT / "docs" / "extensions")]

import sourcepages

import casa_sara

project = "casa_sara"
author = copyright = "the casa_sara maintainers"
version = release = casa_sara.__version__

extensions = [
    "myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.linkcode",
    "taskpages", "apipages", "sourcepages",
]
root_doc = "index"
smartquotes = False  # texts are shown as they are written
default_role = "code"  # what stands between single backticks in docstrings
myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 3

# The pages need no CASA: what only CASA has is a mock for autodoc.
autodoc_mock_imports = ["casatools", "casatasks", "casaconfig", "casashell"]
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_default_options = {"exclude-members": "__weakref__"}
napoleon_google_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True

html_theme = "furo"
html_title = "casa_sara"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_js_files = ["pictures.js"]
html_copy_source = False


def linkcode_resolve(domain, info):
    """Return where the source of an object of an API page is, relative to that page."""
    path = ROOT.joinpath(*info["module"].split(".")) if info["module"] else None
    path = path and (path / "__init__.py" if path.is_dir() else path.with_suffix(".py"))
    if domain != "py" or not path or not path.exists():
        return None
    line = sourcepages.definitions(path).get(info["fullname"], (0, 0))[0]
    return f"../{sourcepages.page_of(path)}.html" + (f"#line-{line}" if line else "")
