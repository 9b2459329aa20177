"""Reading and checking the record that tsara writes with its images."""

from __future__ import annotations

import math
import os
from typing import Any

from casa_sara.runtime import jsonfile

__all__ = ["read_record"]

_LATEST_S = 1e11  # MJD seconds, in the year 5000
_OF_BLOCK = ("samples", "start_mjd_s", "end_mjd_s", "noise_found", "noise_measured")


def read_record(path: str | os.PathLike) -> dict[str, Any]:
    """Read a record and check the entries that the comparison and the report use.

    Raises
    ------
    ValueError
        It is no JSON, or not as tsara writes it: the message names `models`, the file and the entry.
    """
    try:
        record = jsonfile.load(path)
        _check(isinstance(record, dict), "it", "names and values")
        _check_history(record.get("history") or {})
        for name in ("bounds", "reweightings", "blocks", "wild"):
            entries = record.get(name) or []
            _check(isinstance(entries, list) and all(isinstance(entry, dict) for entry in entries), name,
                   "a list of records")
            for entry in entries:
                _check(name not in ("bounds", "reweightings") or _are_numbers(entry.get("iteration")), name,
                       "of iterations")
        _check_bounds(record.get("bounds") or [])
        for block in record.get("blocks") or []:
            _check_block(block)
    except ValueError as error:
        raise ValueError(f"models: '{path}' is not a record of tsara: {error}; it can be deleted") from error
    return record


def _check(right, name, words):
    if not right:
        raise ValueError(f"{name} should be {words}")


def _are_numbers(*values):
    """Whether all are numbers, NaN among them."""
    return all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in values)


def _check_history(history):
    """One list of numbers for each name, all of one length."""
    _check(isinstance(history, dict) and all(isinstance(column, list) and _are_numbers(*column)
                                             for column in history.values()), "history", "lists of numbers")
    _check(len({len(column) for column in history.values()}) < 2, "history", "lists of one length")
    _check(not history or history.get("iteration"), "history", "numbered by iteration")


def _check_bounds(bounds):
    """Lists of numbers, one for each block."""
    lists = [entry.get("l2_bounds") for entry in bounds]
    _check(all(isinstance(one, list) and one and _are_numbers(*one) for one in lists), "bounds", "lists of numbers")
    _check(len(set(map(len, lists))) < 2, "bounds", "lists of one length")


def _check_block(block):
    """What is known of a block: where it comes from and when, how many samples it has, and its noise."""
    _check(isinstance(block.get("ms"), str) and isinstance(block.get("scans"), list), "blocks", "of a MeasurementSet")
    if "noise_found" not in block:
        return
    _check(_are_numbers(*map(block.get, _OF_BLOCK)), "blocks", "of " + ", ".join(_OF_BLOCK))
    times = block["start_mjd_s"], block["end_mjd_s"]
    _check(all(0 <= time < _LATEST_S for time in times) and math.isfinite(block["noise_found"]), "blocks",
           "of this age")
