"""CASA's selection parser (MSSelection, which tclean uses), with clear errors."""

from __future__ import annotations

import os
import re

import numpy as np

from casa_sara.casa.ms.subtables import readable, texts
from casa_sara.casa.runtime.tools import opened

__all__ = ["MSSELECT_KEYS", "for_parser", "in_words", "msselect"]

MSSELECT_KEYS = {
    "field": "field",
    "spw": "spw",
    "timerange": "time",
    "uvrange": "uvdist",
    "antenna": "baseline",
    "scan": "scan",
    "observation": "observation",
    "intent": "scanintent",
}


def in_words(strings):
    """Spell a selection for a message."""
    return ", ".join(f"{parameter} = '{value}'" for parameter, value in strings.items()) or "the empty selection"


def for_parser(name, strings):
    """Return a selection with the numbers of those fields whose names the parser does not read: they are not ASCII."""
    if strings.get("field", "").isascii():
        return strings
    names, words = texts(name, "FIELD", "NAME"), []
    for word in strings["field"].split(","):
        words += [str(number) for number, one in enumerate(names)
                  if one == word.strip() and not one.isascii()] or [word]
    return strings | {"field": ",".join(words)}


def msselect(name, strings):
    """Return the rows and channels of a MeasurementSet that CASA's parser selects.

    Parameters
    ----------
    name : str
        Path of the MeasurementSet.
    strings : dict
        Task parameter → expression, none of them empty.

    Returns
    -------
    rows : int64 (R,)
        Increasing row numbers; R = 0 when the expressions are right and nothing answers them.
    channels : dict
        Spectral window → its selected channels, increasing; {} means all channels of all.

    Raises
    ------
    ValueError
        When an expression is wrong: the parser returns False and leaves all rows selected.
    """
    if not strings:
        with opened("table", name) as tb:
            return np.arange(tb.nrows()), {}
    strings = for_parser(name, strings)
    with opened("ms", readable(name)) as tool:
        try:
            understood = tool.msselect({MSSELECT_KEYS[parameter]: value for parameter, value in strings.items()})
        except UnicodeDecodeError:  # the parser cuts its message between the bytes of a letter
            raise ValueError(f"{in_words(strings)} does not select from '{name}': it holds letters that CASA does not "
                             "understand") from None
        if understood:
            ranges = np.asarray(tool.msselectedindices()["channel"]).reshape(-1, 4).tolist()
            rows = np.sort(tool.range(["rows"])["rows"])
        elif tool.nrow(True) == 0:
            return np.arange(0), {}
    if not understood:
        _raise_bad_expression(name, strings)
    _check_channels(name, strings.get("spw", ""))
    channels = {}
    for spw, first, last, step in ranges:
        channels.setdefault(spw, set()).update(range(first, last + 1, step))
    channels = {spw: np.array(sorted(numbers)) for spw, numbers in channels.items()}
    return _rows_with_channels(name, rows, channels), channels


def _check_channels(name, spw):
    """Raise on channels beyond the last: the parser would take the last one instead."""
    with opened("table", os.path.join(readable(name), "SPECTRAL_WINDOW")) as tb:
        counts = tb.getcol("NUM_CHAN")
    for window, ranges in re.findall(r"(?:^|,)\s*(\d+)\s*:([^,]*)", spw):
        last = counts[int(window)] - 1
        for one in ranges.split(";"):
            channels = re.fullmatch(r"\s*(\d+)\s*(~\s*\d+\s*)?(\^\s*\d+\s*)?", one)
            if channels and int(channels[1]) > last:
                raise ValueError(
                    f"spw = '{spw}': channel {channels[1]} is beyond {last}, the last of spw {window} in '{name}'"
                )


def _rows_with_channels(name, rows, channels):
    """Leave out rows of which the parser selects no channel (spw = '*:8~9GHz' keeps them all)."""
    if not channels:
        return rows
    with opened("table", os.path.join(name, "DATA_DESCRIPTION")) as tb:
        has_channels = np.isin(tb.getcol("SPECTRAL_WINDOW_ID"), list(channels))
    with opened("table", name) as tb:
        return rows[has_channels[tb.getcol("DATA_DESC_ID")[rows]]]


def _raise_bad_expression(name, strings):
    """Find the parameter that the parser did not understand: it selects all rows and returns False."""
    for parameter, value in strings.items():
        with opened("ms", readable(name)) as tool:
            if tool.msselect({MSSELECT_KEYS[parameter]: value}) or tool.nrow(True) == 0:
                continue
            try:
                tool.msselectedindices()
                reason = "no match was found for it"
            except (RuntimeError, UnicodeDecodeError) as error:
                reason = str(error).replace("\n", " ").strip()
        raise ValueError(f"{parameter} = '{value}' does not select from '{name}': {reason}")
    raise ValueError(f"{in_words(strings)} cannot be applied to '{name}'")
