"""Checks that a MeasurementSet is complete, since an incomplete one can make CASA hang or crash."""

from __future__ import annotations

import os
from contextlib import contextmanager

import numpy as np

from casa_sara.casa.ms.subtables import readable
from casa_sara.casa.ms.table_cells import first_misfit
from casa_sara.casa.runtime.tools import opened

__all__ = ["check_measurement_set", "reading"]

_LATEST_S = 1e11  # MJD seconds, in the year 5000
_NEEDED = {"UVW", "ANTENNA1", "DATA_DESC_ID", "FLAG"}
# of the main table, as CASA asks for them: type → columns; those with axes
_REQUIRED = {
    "int": ("ANTENNA1", "ANTENNA2", "ARRAY_ID", "DATA_DESC_ID", "FEED1", "FEED2", "FIELD_ID", "OBSERVATION_ID",
            "PROCESSOR_ID",
            "SCAN_NUMBER", "STATE_ID"),
    "double": ("EXPOSURE", "INTERVAL", "TIME", "TIME_CENTROID", "UVW"),
    "boolean": ("FLAG", "FLAG_CATEGORY", "FLAG_ROW"),
    "float": ("SIGMA", "WEIGHT"),
}
_OPTIONAL = {"complex": ("DATA", "CORRECTED_DATA", "MODEL_DATA"), "float": ("WEIGHT_SPECTRUM", "SIGMA_SPECTRUM")}
_ARRAYS = {"UVW", "FLAG", "FLAG_CATEGORY", "SIGMA", "WEIGHT"} | {name for names in _OPTIONAL.values() for name in names}
_IDENTIFIERS = {"ANTENNA1": "ANTENNA", "ANTENNA2": "ANTENNA", "DATA_DESC_ID": "DATA_DESCRIPTION",
                "OBSERVATION_ID": "OBSERVATION"}


@contextmanager
def reading(name):
    """Turn the errors of CASA and Python about an unreadable MeasurementSet into a ValueError that names `vis`."""
    try:
        yield
    except (RuntimeError, UnicodeDecodeError, SystemError) as error:
        raise ValueError(f"vis = '{name}' cannot be read: {' '.join(str(error).split())}") from error


def check_measurement_set(name):
    """Raise unless `name` is a MeasurementSet with rows, whose numbers do not make CASA crash.

    msmetadata ends the process at a frequency that is no number, and never returns from such a time. Subtables with
    something wrong are set right in a copy (:func:`casa_sara.casa.ms.subtables.readable`), or refused where all is
    wrong.

    Raises
    ------
    FileNotFoundError, ValueError
        With the reason, and the row where it is one.
    """
    if not os.path.exists(name):
        raise FileNotFoundError(f"vis = '{name}' does not exist")
    if not os.path.isdir(name):
        raise ValueError(
            f"vis = '{name}' is a file: a MeasurementSet is a directory (importuvfits makes one of a UVFITS file)"
        )
    if not os.path.exists(os.path.join(name, "table.dat")):
        raise ValueError(f"vis = '{name}' is a directory, but not a MeasurementSet: it holds no table.dat")
    try:
        with opened("table", name) as tb:
            missing, rows = sorted(_NEEDED - set(tb.colnames())), tb.nrows()
    except (RuntimeError, UnicodeDecodeError) as error:
        raise ValueError(f"vis = '{name}' cannot be opened as a table: {error}") from error
    if missing:
        raise ValueError(f"vis = '{name}' is a CASA table, but not a MeasurementSet: it has no column "
                         f"{', '.join(missing)}")
    if rows == 0:
        raise ValueError(f"vis = '{name}' is a MeasurementSet without rows")
    with reading(name), opened("table", name) as tb:
        _check_columns(tb, name)
        _check_numbers(name)
        _check_identifiers(tb, name)


def _check_columns(tb, name):
    """Raise unless the columns of the main table are those that CASA requires."""
    there = tb.getdesc()
    for kind, column in [(kind, one) for kinds in (_REQUIRED, _OPTIONAL) for kind, names in kinds.items()
                         for one in names]:
        if column not in there:
            if column in _REQUIRED.get(kind, ()):
                raise ValueError(f"vis = '{name}' has no column {column}, which every MeasurementSet has")
            continue
        right = f"{kind}, in arrays" if column in _ARRAYS else kind
        found = there[column]["valueType"] + (", in arrays" if "ndim" in there[column] else "")
        if found != right:
            raise ValueError(f"vis = '{name}': {column} holds values of type {found}: should be {right}")
    misfit = first_misfit(tb, "UVW", (3,))
    if misfit:
        raise ValueError(f"vis = '{name}': {misfit}")


def _check_identifiers(tb, name):
    """Raise on numbers of antennas, data descriptions and observations that the subtables do not have."""
    counts = {}
    for subtable in set(_IDENTIFIERS.values()):
        with opened("table", os.path.join(name, subtable)) as of_subtable:
            counts[subtable] = of_subtable.nrows()
    for column, subtable in _IDENTIFIERS.items():
        values = tb.getcol(column)
        right = (values >= 0) & (values < counts[subtable])
        if not right.all():
            row = int(np.argmin(right))
            _check(name, column, row, values[row], right[row], f"a row of {subtable}, 0 to {counts[subtable] - 1}")


def _check_numbers(name):
    """Raise on times and fields that are none."""
    readable(name)
    with opened("table", os.path.join(name, "FIELD")) as tb:
        fields = tb.nrows()
    with opened("table", name) as tb:
        time, interval, field = (tb.getcol(column) for column in ("TIME", "INTERVAL", "FIELD_ID"))
    for column, values, right, words in (
        # 0: not filled
        ("TIME", time, (time >= 0) & (time < _LATEST_S) & ((time > 0) | ~time.any()), "a time in MJD seconds"),
        ("INTERVAL", interval, np.abs(interval) < _LATEST_S, "a number of seconds"),
        ("FIELD_ID", field, (field >= 0) & (field < fields), f"a row of FIELD, 0 to {fields - 1}"),
    ):
        if not right.all():
            row = int(np.argmin(right))
            _check(name, column, row, values[row], right[row], words)


def _check(name, column, row, values, right, words):
    """Raise unless all values of this cell are right."""
    if not np.all(right):
        wrong = np.ravel(values)[np.argmin(np.ravel(right))]
        raise ValueError(f"vis = '{name}': {column} of row {row} holds {wrong}: should be {words}")
