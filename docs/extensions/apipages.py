"""API pages: behind the text of a page api/NAME, every public module of the package casa_sara.NAME, by autodoc.

The page api/options has the modules that stand beside the packages. Modules that begin with an underscore are left out.
"""

from __future__ import annotations

import re
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[2] / "casa_sara"
BESIDE = "options"
SEVERAL = re.compile(r"\w+(, \w+)+(?= :|$)")  # attributes in one line


def modules(page: str) -> list[str]:
    """Return the names of the modules of an API page."""
    paths = PACKAGE.glob("*.py") if page == BESIDE else (PACKAGE / page).rglob("*.py")
    names = (".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)
             for path in paths if not path.stem.startswith("_"))
    return sorted(names)


def api_page(page: str) -> str:
    """Return the sections of an API page, in MyST Markdown."""
    parts = [f"## {name}\n\n```{{eval-rst}}\n.. automodule:: {name}\n   :members:\n```"
             for name in modules(page)]
    return "\n\n".join(parts) + "\n"


def _append(app, docname, source):
    folder, _, name = docname.rpartition("/")
    if folder == "api" and name != "index":
        source[0] += "\n" + api_page(name)


def _as_text(app, what, name, obj, options, lines):
    """Escape bars and asterisks, which the docstrings mean as they stand; keep names together that share a text."""
    attributes = False
    for number, line in enumerate(lines):
        if line.startswith("---"):
            attributes = lines[number - 1] == "Attributes"
        if attributes and SEVERAL.match(line):
            line = lines[number] = SEVERAL.sub(lambda names: names[0].replace(", ", ","), line)
        if "``" not in line:
            lines[number] = line.replace("|", r"\|").replace("*", r"\*")


def setup(app):
    """Enter the extension into Sphinx."""
    app.connect("source-read", _append)
    app.connect("autodoc-process-docstring", _as_text, priority=400)  # before napoleon
    return {"parallel_read_safe": True}
