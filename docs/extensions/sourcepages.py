"""Pages with the source code, and links to lines of it that are found when the site is built.

A link to a Python file, as `[text](../casa_sara/data/noise.py)`, opens the page of that file. Where its text is the
name of a function, a class or a method of the file, as in

    [`AdaptivePPD.step`](../casa_sara/solver/adaptive_ppd.py "Step 13")

it opens the line of its definition and says the number; with a title, the line within the definition that holds this
text. A name or a text that is not there is an error of the build. Links to folders and other files of the repository,
which have no page, are for readers of the repository: on the site they are plain text.
"""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("casa_sara", "docs", "tools")  # whose files have pages


class NotThere(LookupError):
    """A name or a text that a file does not have."""


@cache
def definitions(path: Path) -> dict[str, tuple[int, int]]:
    """Return first and last line of every function, class, method and module-level name of a Python file."""
    found = {}

    def visit(nodes, prefix):
        for node in nodes:
            span = node.lineno, node.end_lineno
            if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
                found[prefix + node.name] = span
                visit(node.body, f"{prefix}{node.name}.")
            elif isinstance(node, ast.Assign):
                targets = [name for target in node.targets for name in getattr(target, "elts", [target])]
                found.update({prefix + name.id: span for name in targets if isinstance(name, ast.Name)})
            elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                found[prefix + node.target.id] = span

    visit(ast.parse(path.read_text()).body, "")
    return found


def line_of(path: Path, name: str, text: str = "") -> int:
    """Return the line where `name` is defined in a file, or the first within the definition that holds `text`."""
    if name not in definitions(path):
        raise NotThere(f"{path.name} has no {name}")
    first, last = definitions(path)[name]
    if not text:
        return first
    lines = path.read_text().splitlines()
    for number in range(first, last + 1):
        if text in lines[number - 1]:
            return number
    raise NotThere(f"{name} in {path.name} has no line with {text!r}")


def page_of(path: Path) -> str:
    """Return the name of the page of a file."""
    return "source/" + path.relative_to(ROOT).as_posix()


def is_definition(text: str, path: Path) -> bool:
    """Return whether the text of a link to a file is meant as a name in it, rather than as that of the file."""
    if text == path.name or text == path.stem and text not in definitions(path):
        return False
    return all(part.isidentifier() for part in text.split("."))


def setup(app):
    """Enter the extension into Sphinx."""
    from docutils import nodes
    from pygments import highlight
    from pygments.formatters import HtmlFormatter
    from pygments.lexers import PythonLexer
    from sphinx import addnodes
    from sphinx.transforms import SphinxTransform
    from sphinx.util import logging

    logger = logging.getLogger(__name__)

    class SourceLinks(SphinxTransform):
        """Turn links to Python files into links to their pages."""

        default_priority = 10

        def apply(self):
            docs = Path(self.env.srcdir)
            self.folder = (docs / self.env.docname).parent
            for node in list(self.document.findall(addnodes.download_reference)):
                path = (self.folder / node["reftarget"]).resolve()
                if path.suffix == ".py":
                    node.replace_self(self.link(node, path))
                elif docs not in path.parents:
                    node.replace_self(node.children)
            for node in list(self.document.findall(addnodes.pending_xref)):
                path = (self.folder / node["reftarget"]).resolve()
                if node["reftype"] == "myst" and docs not in path.parents and (
                        path.is_dir() or path.with_name(path.name + ".md").exists()):
                    node.replace_self(node.children)

        def link(self, node, path):
            text, fragment, where = node.astext(), "", []
            if not path.exists() or path.relative_to(ROOT).parts[0] not in FOLDERS:
                logger.warning("%s has no page", path, location=node)
                return node.children
            if is_definition(text, path):
                try:
                    line = line_of(path, text, node.get("reftitle", ""))
                except NotThere as error:
                    logger.warning("%s", error, location=node)
                    return node.children
                fragment = f"#line-{line}"
                where = [nodes.Text(" "), nodes.inline("", f"{path.name}:{line}", classes=["code-line"])]
            depth = "../" * self.env.docname.count("/")
            uri = f"{depth}{page_of(path)}.html{fragment}"
            return nodes.reference("", "", *node.children, *where, refuri=uri, internal=True)

    def pages(app):
        formatter = HtmlFormatter(linenos="inline", lineanchors="line", anchorlinenos=True, cssclass="highlight")
        for path in sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")):
            title = path.relative_to(ROOT).as_posix()
            body = f"<h1>{title}</h1>" + highlight(path.read_text(), PythonLexer(), formatter)
            yield page_of(path), {"title": title, "body": body, "parents": []}, "page.html"

    app.add_transform(SourceLinks)
    app.connect("html-collect-pages", pages)
    return {"parallel_read_safe": True}
