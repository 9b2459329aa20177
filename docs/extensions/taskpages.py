"""Task pages in the form of CASAdocs, written from xml/*.xml: Description, Parameters, Returns, Examples.

A page `tasks/NAME.md` of the site has a title and a line of its own; the rest is put behind it while it is read. The
XML is read by tools/taskxml.py, which also makes the tasks and their help.
"""

from __future__ import annotations

import re
import textwrap
from pathlib import Path

from taskxml import SCALARS, VECTORS, Param, Task, read_task

ROOT = Path(__file__).resolve().parents[2]
XML = ROOT / "xml"
WORDS = {"bool": "bool", "int": "int", "double": "float", "string": "string", "path": "path"}
SPECIAL = re.compile(r"([\\`*_{}\[\]<>#|])")
EXAMPLES = re.compile(r"Examples?: ")


def task_page(task: Task) -> str:
    """Return the sections of a task's page, in MyST Markdown."""
    names = [param.name for param in task.params]
    parts = [
        f"*{_escaped(task.summary)}.*",
        f"## Description\n\n{as_markdown(task.description, task.name, names)}",
        f"## Parameters\n\n{_overview(task)}",
        *(_entry(param, task.name, names) for param in task.params),
        f"## Returns\n\n{_returns(task, names)}",
        "## Examples",
        *(f"{_escaped(example.caption)}\n\n```python\n{example.code}\n```" for example in task.examples),
    ]
    return "\n\n".join(parts) + "\n"


def as_markdown(text: str, task: str, names: list[str]) -> str:
    """Return a help text of the XML in Markdown.

    Blank lines part paragraphs, "- " begins an item of a list, "Example: " an example, with more of them below,
    and indented lines are kept as they are. `name=value` is linked to the parameter where it is one.
    """
    blocks: list[list[str]] = []
    for line in text.splitlines():
        kind = _kind(line, blocks[-1] if blocks else ["", ""])
        if not blocks or kind != blocks[-1][0] or kind == "item" and line.startswith("- "):
            blocks.append([kind])
        blocks[-1].append(line)
    made = [_block(kind, lines, task, names) for kind, *lines in blocks if kind != "blank"]
    return "\n\n".join(made)


def _kind(line: str, before: list[str]) -> str:
    """Return what a line belongs to, with the lines of the block before, its kind first."""
    if not line.strip():
        return "blank"
    if line.startswith("- ") or before[0] == "item" and line.startswith("  "):
        return "item"
    if EXAMPLES.match(line) or before[0] == "examples" and line.startswith(" "):
        return "examples"
    return "kept" if line.startswith(" ") else "paragraph"


def _block(kind: str, lines: list[str], task: str, names: list[str]) -> str:
    if kind == "examples":
        lines[0] = EXAMPLES.sub(lambda label: " " * len(label[0]), lines[0])
        return "```python\n" + textwrap.dedent("\n".join(lines)) + "\n```"
    if kind == "kept":
        return "```text\n" + textwrap.dedent("\n".join(lines)) + "\n```"
    if kind == "item":
        return "- " + _linked(" ".join(line.strip() for line in lines).removeprefix("- "), task, names)
    return _linked("\n".join(lines), task, names)


def _linked(text: str, task: str, names: list[str]) -> str:
    """Escape a text, and link each `name=value` in it to the parameter."""
    assignment = re.compile(rf"\b({'|'.join(names)})=('[^']*'|\[[^\]]*\]|[\w.+-]*\w)")
    parts, end = [], 0
    for found in assignment.finditer(text):
        parts += [_escaped(text[end:found.start()]), f"[`{found[0]}`](#{task}-{found[1]})"]
        end = found.end()
    return "".join([*parts, _escaped(text[end:])])


def _escaped(text: str) -> str:
    return SPECIAL.sub(r"\\\1", text).replace("''", "`''`")


def _overview(task: Task) -> str:
    """Return the table of all parameters, sub-parameters indented, as `inp` shows them."""
    rows = ["| Parameter | Default | |", "|---|---|---|"]
    for param in task.params:
        indent = "&nbsp;&nbsp;&nbsp;" * param.subparam
        rows.append(f"| {indent}[`{param.name}`](#{task.name}-{param.name}) | {_default(param)} | "
                    f"{_escaped(param.summary)} |")
    return "\n".join(rows)


def _entry(param: Param, task: str, names: list[str]) -> str:
    """Return the section of one parameter."""
    facts = [f"**Type** {_types(param)}", f"**Default** {_default(param)}"]
    if allowed := _allowed(param):
        facts.append(f"**Allowed** {allowed}")
    if param.opener:
        relation = "=" if param.opening == "equals" else " other than "
        values = " or ".join(f"`{value!r}`" for value in param.values)
        facts.append(f"**Sub-parameter of** [`{param.opener}`](#{task}-{param.opener}){relation}{values}")
    level = "#" * (4 if param.subparam else 3)
    return "\n\n".join([f"({task}-{param.name})=\n{level} {param.name}", f"*{_escaped(param.summary)}*",
                        " · ".join(facts), as_markdown(param.description, task, names)])


def _types(param: Param) -> str:
    return " or ".join(WORDS[name] if name in SCALARS else f"list of {WORDS.get(VECTORS[name], VECTORS[name])}"
                       for name in param.types)


def _default(param: Param) -> str:
    return "none, must be given" if param.required else f"`{param.default!r}`"


def _allowed(param: Param) -> str:
    if param.allowed:
        return ", ".join(f"`{value!r}`" for value in param.allowed)
    low, high = (None if end is None else f"{end:g}" for end in (param.minimum, param.maximum))
    if low and high:
        return f"{low} to {high}"
    return f"at least {low}" if low else f"at most {high}" if high else ""


def _returns(task: Task, names: list[str]) -> str:
    kind, text = task.returns.split("\n", 1)
    return f"**{_escaped(kind)}**: " + as_markdown(textwrap.dedent(text), task.name, names)


def _append(app, docname, source):
    """Put the generated sections behind the text of a page tasks/NAME."""
    folder, _, name = docname.rpartition("/")
    if folder == "tasks" and name != "index":
        xml = XML / f"{name}.xml"
        app.env.note_dependency(str(xml))
        source[0] += "\n" + task_page(read_task(xml))


def setup(app):
    """Enter the extension into Sphinx."""
    app.connect("source-read", _append)
    return {"parallel_read_safe": True}
