"""Read the <example> of a task's XML strictly: captions that end with a colon, each with its code.

    Dirty images only:

    tsara(vis='a.ms', imagename='dirty', cell='0.1arcsec', niter=0)

The code is Python that calls the task by keywords, or what one types in the CASA shell: `inp NAME`, assignments, `go`.
Parameters that the task does not have, and values that are not allowed, are errors.
"""

from __future__ import annotations

import ast
from collections.abc import Callable
from typing import Any, NamedTuple

__all__ = ["Example", "read_examples"]


class Example(NamedTuple):
    """One example: what it does, and the code."""

    caption: str
    code: str


def read_examples(text: str, task: str, check: Callable[[str, Any], None]) -> tuple[Example, ...]:
    """Return the examples in a text.

    Parameters
    ----------
    text : str
    task : str
        Name of the task.
    check : callable
        Called with the name and the value of every parameter that is set; the value is None where it is an expression.

    Raises
    ------
    ValueError
        Where the text is not as it should be.
    """
    examples: list[list[str]] = []
    for chunk in text.split("\n\n"):
        if chunk.rstrip().endswith(":"):
            examples.append([" ".join(chunk.split())])
        elif not examples:
            raise ValueError("should begin with a caption, which ends with a colon")
        else:
            examples[-1].append(chunk.strip("\n"))
    made = tuple(Example(caption, "\n\n".join(code)) for caption, *code in examples)
    for example in made:
        for name, value in _settings(example, task):
            check(name, value)
    return made


def _settings(example: Example, task: str):
    """Yield name and value of every parameter that an example sets."""
    lines = example.code.splitlines()
    in_shell = bool(lines) and lines[0] == f"inp {task}"
    if in_shell and lines[-1] != "go":
        raise ValueError(f"{example.caption!r} should end with go")
    try:
        tree = ast.parse("\n".join(lines[1:-1]) if in_shell else example.code)
    except SyntaxError as error:
        raise ValueError(f"{example.caption!r} is not Python: {error}") from None
    if in_shell:
        if not all(isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name) for node in tree.body):
            raise ValueError(f"{example.caption!r} should only set parameters between inp and go")
        yield from ((node.targets[0].id, _value(node.value)) for node in tree.body)
        return
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call) and getattr(node.func, "id", "") == task]
    if not calls or any(call.args for call in calls):
        raise ValueError(f"{example.caption!r} should call {task}, by keywords only")
    yield from ((word.arg, _value(word.value)) for call in calls for word in call.keywords if word.arg)


def _value(node: ast.expr) -> Any:
    try:
        return ast.literal_eval(node)
    except ValueError:
        return None
