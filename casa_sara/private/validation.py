"""Check and coerce task parameters: CASA's own validator, with messages that say what would be right."""

from __future__ import annotations

import math
import os
from typing import Any, NamedTuple

__all__ = ["Parameter", "validate", "checked", "plain"]

# The names of the types in xml/*.xml, with the words for them in messages.
TYPE_WORDS = {
    "bool": "True or False",
    "int": "an integer",
    "double": "a number",
    "string": "a string",
    "path": "a path",
    "intVec": "a list of integers",
    "doubleVec": "a list of numbers",
    "stringVec": "a list of strings",
    "pathVec": "a list of paths",
}


class Parameter(NamedTuple):
    """One task parameter, as its XML describes it.

    A sub-parameter has an `opener`, another parameter; it has an effect only while the opener's
    value is one of `open_on` or, where that is empty, none of `open_unless`.
    """

    name: str
    types: tuple[str, ...]
    default: Any
    summary: str
    allowed: tuple = ()
    minimum: float = -math.inf
    maximum: float = math.inf
    mustexist: bool = False
    required: bool = False
    opener: str = ""
    open_on: tuple = ()
    open_unless: tuple = ()

    def is_open(self, values: dict[str, Any]) -> bool:
        """Return whether the parameter has an effect, given the values of all parameters."""
        if not self.opener:
            return True
        value = values[self.opener]
        return value in self.open_on if self.open_on else value not in self.open_unless

    def expected(self) -> str:
        """Return a description of the valid values."""
        words = " or ".join(TYPE_WORDS[name] for name in self.types)
        if self.allowed:
            choice = ", ".join(map(repr, self.allowed))
            return f"{words} out of {choice}" if len(self.allowed) > 1 else f"{choice}, the only choice"
        if self.minimum > -math.inf:
            words += f", at least {self.minimum:g}"
        if self.maximum < math.inf:
            words += f", at most {self.maximum:g}"
        return f"{words} that exists" if self.mustexist else words


def validate(parameters: tuple[Parameter, ...], values: dict[str, Any]) -> dict[str, Any]:
    """Return `values` with CASA's coercions applied.

    Parameters
    ----------
    parameters : tuple of Parameter
        The parameters of the task.
    values : dict
        A value for each parameter, as the user gave it.

    Returns
    -------
    dict
        The same keys; built-in Python types only, and lists that are nobody else's.

    Raises
    ------
    FileNotFoundError
        When nothing is wrong but paths that do not exist.
    ValueError
        For any other wrong value, and for a sub-parameter that is set although the parameter that
        opens it makes it idle. Every problem is named, each in its line.
    """
    clean: dict[str, Any] = {}
    problems: list[Exception] = []
    for parameter in parameters:
        value = plain(values[parameter.name])
        if _is_default(parameter, value):  # is valid; CASA's validator takes a while
            clean[parameter.name] = value
            continue
        try:
            clean[parameter.name] = checked(parameter, values[parameter.name])
        except (ValueError, FileNotFoundError) as problem:
            problems.append(problem)
    if not problems:
        problems = [ValueError(_idle(p, clean)) for p in parameters if not p.is_open(clean) and _is_set(p, clean)]
    if problems:
        missing_only = all(isinstance(problem, FileNotFoundError) for problem in problems)
        raise (FileNotFoundError if missing_only else ValueError)("\n".join(map(str, problems)))
    return clean


def checked(parameter: Parameter, value: Any) -> Any:
    """Return one value, coerced; raise ValueError or FileNotFoundError when it is wrong."""
    from casatools.typecheck import CasaValidator

    name, shown, value = parameter.name, repr(value), plain(value)
    if parameter.required and _is_empty(value):
        raise ValueError(f"{name} = {shown}: must be given, {parameter.expected()}")
    elements = value if isinstance(value, list) else [value]
    wrong = ValueError(f"{name} = {shown}: should be {parameter.expected()}")
    validator = CasaValidator()
    if not validator.validate({name: value}, {name: _rule(parameter)}):
        if parameter.mustexist and all(isinstance(element, str) for element in elements):
            missing = ", ".join(repr(element) for element in elements if not os.path.exists(element))
            raise FileNotFoundError(f"{name} = {shown}: {missing} not found; should be {parameter.expected()}")
        raise wrong
    for element in elements:
        if isinstance(element, bool) and "bool" not in parameter.types:
            raise wrong
        if isinstance(element, (int, float)) and not (
            math.isfinite(element) and parameter.minimum <= element <= parameter.maximum
        ):
            raise wrong
    return validator.document[name]


def plain(value: Any) -> Any:
    """Return `value` as built-in Python: paths as strings, tuples and arrays as lists, numpy scalars as numbers."""
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, (list, tuple)):
        return [plain(element) for element in value]
    return value.tolist() if hasattr(value, "tolist") else value


def _rule(parameter: Parameter) -> dict[str, Any]:
    """Return the rule of one parameter for CasaValidator, as a casatasks task has it."""
    from casatools.coercetype import coerce

    rules = {
        "bool": {"type": "cBool"},
        "int": {"type": "cInt"},
        "double": {"type": "cFloat", "coerce": coerce.to_float},
        "string": {"type": "cStr", "coerce": coerce.to_str},
        "path": {"type": "cReqPath" if parameter.mustexist else "cPath", "coerce": coerce.expand_path},
        "intVec": {"type": "cIntVec", "coerce": [coerce.to_list, coerce.to_intvec]},
        "doubleVec": {"type": "cFloatVec", "coerce": [coerce.to_list, coerce.to_floatvec]},
        "stringVec": {"type": "cStrVec", "coerce": [coerce.to_list, coerce.to_strvec]},
        "pathVec": {
            "type": "cReqPathVec" if parameter.mustexist else "cPathVec",
            "coerce": [coerce.to_list, coerce.expand_pathvec],
        },
    }
    if len(parameter.types) > 1:
        return {"anyof": [rules[name] for name in parameter.types]}
    rule = rules[parameter.types[0]]
    return {**rule, "allowed": list(parameter.allowed)} if parameter.allowed else rule


def _is_empty(value: Any) -> bool:
    """Return whether a plain value stands for "not given": '', [] or ['']."""
    return value in ("", [], [""])


def _is_default(parameter: Parameter, value: Any) -> bool:
    """Return whether a plain value is the parameter's default, of its type, and may be left at it."""
    return not parameter.required and repr(value) == repr(parameter.default)


def _is_set(parameter: Parameter, clean: dict[str, Any]) -> bool:
    value, default = clean[parameter.name], parameter.default
    return value != default and not (_is_empty(value) and _is_empty(default))


def _idle(parameter: Parameter, clean: dict[str, Any]) -> str:
    opener = parameter.opener
    openers = " or ".join(map(repr, parameter.open_on or parameter.open_unless))
    return (
        f"{parameter.name} = {clean[parameter.name]!r} has no effect with {opener} = {clean[opener]!r}: "
        f"set {opener} to {openers if parameter.open_on else 'other than ' + openers}, "
        f"or leave {parameter.name} at {parameter.default!r}"
    )
