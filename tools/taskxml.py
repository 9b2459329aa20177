"""Read CASA task XML strictly: whatever is not understood is an error.

The dialect is CASA's own (casatasks/__xml__/*.xml) in these parts: <param> with type, name,
subparam, mustexist and required (required: may not be left empty); its <shortdescription>,
<description>, <type> (for type="any"), <value>, and <allowed> of kind enum or range; <constraints>
with <when>, <equals> or <notequals>, <default>; <returns> and <example>, which
taskexample.py describes. Anything else is an error, and so is a sub-parameter that nothing opens, that two
parameters open or that does not stand right behind its opener, a missing or wrong default, a constraint on an unknown
value, or a constraint's default that differs from the parameter's own.
"""

from __future__ import annotations

import keyword
import textwrap
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any, NamedTuple

from taskexample import Example, read_examples

__all__ = ["Param", "SCALARS", "Task", "TaskError", "VECTORS", "read_task"]

NAMESPACE = "{http://casa.nrao.edu/schema/psetTypes.html}"
SCALARS = {"bool": "bool", "int": "int", "double": "float", "string": "str", "path": "path"}
VECTORS = {"intVec": "int", "doubleVec": "double", "stringVec": "string", "pathVec": "path"}
NUMBERS = {"int", "double", "intVec", "doubleVec"}


class TaskError(ValueError):
    """What is wrong in an XML file, with the place."""


class Param(NamedTuple):
    """A parameter as parsed; `opening` is "" or "equals" or "notequals" with the opener's `values`."""

    name: str
    types: tuple[str, ...]
    default: Any
    default_type: str
    summary: str
    description: str
    allowed: tuple = ()
    minimum: float | None = None
    maximum: float | None = None
    subparam: bool = False
    mustexist: bool = False
    required: bool = False
    opener: str = ""
    opening: str = ""
    values: tuple = ()


class Task(NamedTuple):
    """A task as parsed."""

    name: str
    group: str
    summary: str
    description: str
    params: tuple[Param, ...]
    returns: str
    example: str
    examples: tuple[Example, ...]


def read_task(path: Path) -> Task:
    """Return the task that the file at `path` describes; raise TaskError where it is not as it should be."""
    try:
        root = ElementTree.parse(path).getroot()
        return _read_root(root, path.stem)
    except (TaskError, ElementTree.ParseError) as error:
        raise TaskError(f"{path.name}: {error}") from None


def _read_root(root: ElementTree.Element, stem: str) -> Task:
    _check(root, "casaxml", "document", children={"task": "1"})
    task = root[0]
    parts = dict.fromkeys(("shortdescription", "description", "input", "returns", "example"), "1")
    attributes = _check(task, "task", "task", needs=("type", "name", "category"), children=parts)
    if attributes["type"] != "function" or attributes["name"] != stem:
        raise TaskError(f"task: should have type=function and the name of the file, {stem}")
    summary, description, inputs, returns, example = (_child(task, part) for part in parts)
    _check(inputs, "input", "input", children={"param": "+", "constraints": "?"})
    params: dict[str, Param] = {}
    for element in inputs.findall(NAMESPACE + "param"):
        param = _read_param(element)
        if param.name in params:
            raise TaskError(f"param {param.name}: is there twice")
        params[param.name] = param
    for element in inputs.findall(NAMESPACE + "constraints"):
        _read_constraints(element, params)
    _check_openers(list(params.values()))
    texts = (_text(element, "task") for element in (summary, description, returns, example))
    summary, description, returns, example = texts
    return Task(stem, attributes["category"], _one_line(summary, "task"), description, tuple(params.values()),
                returns, example, _read_example(example, stem, params))


def _read_example(text: str, task: str, params: dict[str, Param]) -> tuple[Example, ...]:
    def check(name, value):
        if name not in params:
            raise ValueError(f"{task} has no parameter {name}")
        if value is not None and params[name].allowed and not (
                set(value) <= set(params[name].allowed) if isinstance(value, list) else value in params[name].allowed):
            raise ValueError(f"{value!r} is not a value of {name}")

    try:
        return read_examples(text, task, check)
    except ValueError as error:
        raise TaskError(f"example: {error}") from None


def _read_param(element: ElementTree.Element) -> Param:
    name = element.get("name", "")
    where = f"param {name}"
    if not name.isidentifier() or keyword.iskeyword(name):
        raise TaskError(f"{where}: not a name for a parameter")
    parts = {"shortdescription": "1", "description": "1", "type": "*", "value": "1", "allowed": "?"}
    attributes = _check(element, "param", where, needs=("type", "name"), children=parts,
                        flags=("subparam", "mustexist", "required"))
    types = tuple((item.text or "").strip() for item in element.findall(NAMESPACE + "type"))
    if (attributes["type"] == "any") != (len(types) > 1) or len(types) == 1:
        raise TaskError(f"{where}: type=any needs two or more <type>, another type none")
    types = types or (attributes["type"],)
    for item in types:
        if item not in SCALARS and item not in VECTORS:
            raise TaskError(f"{where}: unknown type {item!r}")
    param = Param(
        name, types, None, "",
        _one_line(_text(_child(element, "shortdescription"), where), where),
        _text(_child(element, "description"), where),
        **{flag: flag in attributes for flag in ("subparam", "mustexist", "required")},
    )
    for allowed in element.findall(NAMESPACE + "allowed"):
        param = _read_allowed(allowed, param)
    value = _child(element, "value")
    param = param._replace(default_type=value.get("type", types[0]))
    if param.default_type not in types:
        raise TaskError(f"{where}: the type of <value> should be one of {', '.join(types)}")
    return param._replace(default=_read_value(value, param, where, needs=("type",) if len(types) > 1 else ()))


def _read_allowed(element: ElementTree.Element, param: Param) -> Param:
    where = f"param {param.name}"
    kind = _check(element, "allowed", where, needs=("kind",), children={"value": "+"})["kind"]
    if kind == "enum" and len(param.types) == 1:
        scalar = VECTORS.get(param.types[0], param.types[0])
        for item in element:
            _check(item, "value", where, text=True)
        allowed = tuple(_scalar(item.text, scalar, where) for item in element)
        if len(set(allowed)) < len(allowed):
            raise TaskError(f"{where}: an allowed value is there twice")
        return param._replace(allowed=allowed)
    if kind == "range" and NUMBERS >= set(param.types):
        ends = {}
        for item in element:
            end = _check(item, "value", where, needs=("range",), text=True)["range"]
            if end not in ("min", "max") or end in ends:
                raise TaskError(f"{where}: a range has one min, one max, or both")
            ends[end] = _scalar(item.text, "double", where)
        return param._replace(minimum=ends.get("min"), maximum=ends.get("max"))
    raise TaskError(f"{where}: <allowed> is an enum, of one type, or a range, of numbers")


def _read_value(element: ElementTree.Element, param: Param, where: str, needs: tuple[str, ...] = ()) -> Any:
    """Return a default of the type `param.default_type`."""
    own = param.default_type
    if own in VECTORS:
        _check(element, "value", where, needs=needs, children={"value": "*"})
        for item in element:
            _check(item, "value", where, text=True)
        value = elements = [_scalar(item.text, VECTORS[own], where) for item in element]
    else:
        _check(element, "value", where, needs=needs, text=True)
        value = _scalar(element.text, own, where)
        elements = [value]
    for item in elements:
        if not _is_allowed(item, param):
            raise TaskError(f"{where}: {item!r} is not among the allowed values")
    return value


def _read_constraints(element: ElementTree.Element, params: dict[str, Param]) -> None:
    """Enter into `params` which parameter opens which."""
    _check(element, "constraints", "constraints", children={"when": "+"})
    seen = set()
    for when in element:
        opener = _check(when, "when", "when", needs=("param",), children={"equals": "*", "notequals": "*"})["param"]
        where = f"when {opener}"
        if opener not in params or opener in seen or len(params[opener].types) > 1 or len(when) == 0:
            raise TaskError(f"{where}: should name a parameter of one type, once, and open something")
        seen.add(opener)
        branches = set()
        for branch in when:
            opening = branch.tag.removeprefix(NAMESPACE)
            attributes = _check(branch, opening, where, needs=("type", "value"), children={"default": "+"})
            value = _scalar(attributes["value"], params[opener].types[0], where)
            if attributes["type"] != params[opener].types[0] or not _is_allowed(value, params[opener]):
                raise TaskError(f"{where}: {value!r} is not a value of {opener}")
            if (opening, value) in branches:
                raise TaskError(f"{where}: {opening} {value!r} is there twice")
            branches.add((opening, value))
            for default in branch:
                _open(default, params, opener, opening, value)


def _open(element: ElementTree.Element, params: dict[str, Param], opener: str, opening: str, value: Any) -> None:
    name = _check(element, "default", f"when {opener}", needs=("param",), children={"value": "1"})["param"]
    where = f"when {opener}, default {name}"
    param = params.get(name)
    if param is None or not param.subparam or name == opener:
        raise TaskError(f"{where}: should name a sub-parameter")
    if param.opener not in ("", opener) or param.opening not in ("", opening) or value in param.values:
        raise TaskError(f"{where}: is opened twice, or by both equals and notequals")
    if _read_value(_child(element, "value"), param, where) != param.default:
        raise TaskError(f"{where}: differs from the parameter's own default, {param.default!r}")
    params[name] = param._replace(opener=opener, opening=opening, values=(*param.values, value))


def _check_openers(params: list[Param]) -> None:
    """Check that every sub-parameter is opened, by a parameter that is none, and stands right behind it."""
    behind = ""
    for param in params:
        if not param.subparam:
            behind = param.name
        elif not param.opener:
            raise TaskError(f"param {param.name}: is a sub-parameter that nothing opens")
        elif param.opener != behind:
            raise TaskError(f"param {param.name}: should stand right behind {param.opener}, which opens it")


def _check(element: ElementTree.Element, tag: str, where: str, *, needs: tuple[str, ...] = (),
           flags: tuple[str, ...] = (), children: dict[str, str] | None = None, text: bool = False) -> dict[str, str]:
    """Return the attributes of `element`; raise TaskError unless it has just what is named.

    `children` maps tags to how often they may be there: "1", "?", "*" or "+"; `flags` are
    attributes that are absent or "true"; `text` says whether the element holds text.
    """
    if element.tag != NAMESPACE + tag:
        raise TaskError(f"{where}: should be <{tag}>, is <{element.tag.removeprefix(NAMESPACE)}>")
    for name, value in element.attrib.items():
        if name not in (*needs, *flags) or (name in flags and value != "true"):
            raise TaskError(f"{where}: unknown attribute {name}={value!r} of <{tag}>")
    for name in needs:
        if name not in element.attrib:
            raise TaskError(f"{where}: <{tag}> needs the attribute {name}")
    children = children or {}
    counts = dict.fromkeys(children, 0)
    for child in element:
        name = child.tag.removeprefix(NAMESPACE)
        if name not in counts:
            raise TaskError(f"{where}: unknown element <{name}> in <{tag}>")
        counts[name] += 1
    for name, often in children.items():
        if (often in "1+" and counts[name] == 0) or (often in "1?" and counts[name] > 1):
            raise TaskError(f"{where}: <{tag}> has {counts[name]} elements <{name}>")
    stray = [child.tail for child in element] + ([] if text else [element.text])
    if any(part and part.strip() for part in stray):
        raise TaskError(f"{where}: text in <{tag}>")
    return element.attrib


def _child(element: ElementTree.Element, tag: str) -> ElementTree.Element:
    return element.find(NAMESPACE + tag)


def _text(element: ElementTree.Element, where: str) -> str:
    """Return the text of a help element, its indentation removed."""
    tag = element.tag.removeprefix(NAMESPACE)
    _check(element, tag, where, text=True)
    text = textwrap.dedent(element.text or "").strip()
    if not text or "\\" in text or '"""' in text:
        raise TaskError(f'{where}: <{tag}> should have text, without \\ or """')
    return text


def _one_line(text: str, where: str) -> str:
    if "\n" in text:
        raise TaskError(f"{where}: <shortdescription> should be one line")
    return text


def _scalar(text: str | None, type_name: str, where: str) -> Any:
    text = (text or "").strip()
    convert = {"bool": {"True": True, "False": False}.__getitem__, "int": int, "double": float}
    try:
        return convert.get(type_name, str)(text)
    except (KeyError, ValueError):
        raise TaskError(f"{where}: {text!r} is not of type {type_name}") from None


def _is_allowed(value: Any, param: Param) -> bool:
    if param.allowed:
        return value in param.allowed
    low, high = param.minimum, param.maximum
    return (low is None or value >= low) and (high is None or value <= high)
