"""What the linter cannot ask of public functions alone: types, and numpydoc sections for what goes in and comes out."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "casa_sara"
NUMERICS = ("analysis", "data", "operators", "reconstruction", "solver")
TYPED = (*NUMERICS, "parallel", "runtime", "private", "demo")
SECTION = "\n{}\n" + "-" * 4


def public_functions(source):
    """Yield name and definition of each public function and method of a module with arguments."""
    bodies = [("", ast.parse(source).body)]
    while bodies:
        within, body = bodies.pop()
        for node in body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                bodies.append((f"{node.name}.", node.body))
            elif isinstance(node, ast.FunctionDef) and not node.name.startswith("_") and arguments(node):
                yield within + node.name, node


def arguments(function):
    given = function.args
    every = [*given.posonlyargs, *given.args, given.vararg, *given.kwonlyargs, given.kwarg]
    return [one for one in every if one is not None and one.arg not in ("self", "cls")]


def is_compiled(function):
    """Numba finds the types of a kernel itself."""
    return any("jit" in ast.unparse(decorator) or "inlined" in ast.unparse(decorator)
               for decorator in function.decorator_list)


def untyped(function):
    """What has no type, '' if nothing."""
    missing = [one.arg for one in arguments(function) if one.annotation is None]
    return ", ".join(missing + ["what it returns"] * (function.returns is None))


def undescribed(function):
    """Sections of numpydoc that are missing, '' if none; that every argument is in its section is ruff's D417."""
    text = ast.get_docstring(function) or ""
    nothing = function.returns is None or ast.unparse(function.returns) in ("None", "Iterator[None]")
    wanted = [("Parameters",)] + [("Returns", "Yields")] * (not nothing)
    return ", ".join(names[0] for names in wanted if not any(SECTION.format(name) in text for name in names))


def modules(packages):
    return sorted(path.relative_to(PACKAGE).as_posix() for package in packages
                  for path in (PACKAGE / package).rglob("*.py") if not path.name.startswith("_"))


@pytest.mark.parametrize("module", modules(TYPED))
def test_public_functions_have_types(module):
    found = public_functions((PACKAGE / module).read_text())
    assert not {name: wrong for name, function in found if not is_compiled(function) and (wrong := untyped(function))}


@pytest.mark.parametrize("module", modules(NUMERICS))
def test_public_functions_say_what_goes_in_and_comes_out(module):
    found = public_functions((PACKAGE / module).read_text())
    assert not {name: wrong for name, function in found if (wrong := undescribed(function))}


def test_what_is_missing_is_seen():
    bare, half, whole = (function for _, function in sorted(public_functions('''
def a_bare(x):
    """Return x."""
class Owner:
    def b_half(self, x: int) -> int:
        """Return x.

        Parameters
        ----------
        x : int
            Any.
        """
def c_whole(x: int) -> int:
    """Return x.

    Parameters
    ----------
    x : int
        Any.

    Returns
    -------
    int
    """
def _private(x):
    pass
'''), key=lambda found: found[1].name))
    assert untyped(bare) == "x, what it returns" and undescribed(bare) == "Parameters"
    assert not untyped(half) and undescribed(half) == "Returns"
    assert not untyped(whole) and not undescribed(whole)
