"""Records in JSON files, which are replaced atomically."""

from __future__ import annotations

import json
import math
import os
from typing import Any

from casa_sara.runtime.atomic import new_file

__all__ = ["load", "plain", "save"]

_WORDS = {"NaN": math.nan, "Infinity": math.inf, "-Infinity": -math.inf}  # JSON has no numbers for these


def plain(value: Any) -> Any:
    """Return `value` as dicts with text keys, lists, numbers, strings and None; arrays become lists."""
    if isinstance(value, dict):
        return {str(key): plain(entry) for key, entry in value.items()}
    if hasattr(value, "tolist"):
        value = value.tolist()
    return [plain(entry) for entry in value] if isinstance(value, (list, tuple)) else value


def save(path: str | os.PathLike, value: Any) -> None:
    """Write `value` to a new file, which takes its place when it is complete."""
    text = json.dumps(_spelled(plain(value)), allow_nan=False, indent=1) + "\n"
    with new_file(path) as file:
        file.write(text.encode())


def load(path: str | os.PathLike) -> Any:
    """Read what `save` wrote.

    Raises
    ------
    ValueError
        It is no JSON, or nested without end; the message names the file.
    """
    try:
        with open(path, encoding="utf-8") as file:
            return _numbers(json.load(file))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"'{path}' is not the JSON that was written: {error}") from error


def _spelled(value: Any) -> Any:
    """Return `value` with the numbers that JSON lacks as text."""
    if isinstance(value, dict):
        return {key: _spelled(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_spelled(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    return value


def _numbers(value: Any) -> Any:
    """Return `value` with that text as numbers again."""
    if isinstance(value, dict):
        return {key: _numbers(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_numbers(entry) for entry in value]
    return _WORDS.get(value, value) if isinstance(value, str) else value
