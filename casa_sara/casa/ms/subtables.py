"""The subtables of a MeasurementSet: a check of their cells, and corrected copies for CASA.

A single number that is not finite, an empty cell or a character that is not UTF-8, even in a row that no data refer to,
makes CASA refuse the whole MeasurementSet, hang, or end the process. The table tool can read all of them, so the
subtables are checked here first. Where a cell is wrong, CASA's other tools are given a folder with links to the files
of the MeasurementSet and corrected copies of the subtables in question. A wrong cell on which the image depends is an
error when selected data refer to it. The MeasurementSet itself is not changed.
"""

from __future__ import annotations

import os
import re
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from casa_sara.casa.runtime.tools import opened

__all__ = ["check_rows", "readable", "texts"]

_COLUMNS = {  # that CASA wants in the subtables: type, and 'arrays' → names
    "ANTENNA": {"string": "MOUNT NAME STATION TYPE", "double": "DISH_DIAMETER", "double arrays": "OFFSET POSITION",
                "boolean": "FLAG_ROW"},
    "DATA_DESCRIPTION": {"int": "POLARIZATION_ID SPECTRAL_WINDOW_ID", "boolean": "FLAG_ROW"},
    "FIELD": {"string": "CODE NAME", "int": "NUM_POLY SOURCE_ID", "double": "TIME",
              "double arrays": "DELAY_DIR PHASE_DIR REFERENCE_DIR", "boolean": "FLAG_ROW"},
    "OBSERVATION": {"string": "OBSERVER PROJECT SCHEDULE_TYPE TELESCOPE_NAME", "string arrays": "LOG SCHEDULE",
                    "double": "RELEASE_DATE", "double arrays": "TIME_RANGE", "boolean": "FLAG_ROW"},
    "POLARIZATION": {"int": "NUM_CORR", "int arrays": "CORR_PRODUCT CORR_TYPE", "boolean": "FLAG_ROW"},
    "SPECTRAL_WINDOW": {"string": "FREQ_GROUP_NAME NAME",
                        "int": "FREQ_GROUP IF_CONV_CHAIN MEAS_FREQ_REF NET_SIDEBAND NUM_CHAN",
                        "double": "REF_FREQUENCY TOTAL_BANDWIDTH",
                        "double arrays": "CHAN_FREQ CHAN_WIDTH EFFECTIVE_BW RESOLUTION",
                        "boolean": "FLAG_ROW"},
    "STATE": {"string": "OBS_MODE", "int": "SUB_SCAN", "double": "CAL LOAD", "boolean": "FLAG_ROW REF SIG"},
    "SOURCE": {"string": "CODE NAME", "int": "CALIBRATION_GROUP NUM_LINES SOURCE_ID SPECTRAL_WINDOW_ID",
               "double": "INTERVAL TIME", "double arrays": "DIRECTION PROPER_MOTION REST_FREQUENCY SYSVEL"},
    "FEED": {"int": "ANTENNA_ID BEAM_ID FEED_ID NUM_RECEPTORS SPECTRAL_WINDOW_ID", "double": "INTERVAL TIME",
             "double arrays": "BEAM_OFFSET POSITION RECEPTOR_ANGLE", "complex arrays": "POL_RESPONSE",
             "string arrays": "POLARIZATION_TYPE"},
    "FLAG_CMD": {"string": "COMMAND REASON TYPE", "int": "LEVEL SEVERITY", "double": "INTERVAL TIME",
                 "boolean": "APPLIED"},
    "HISTORY": {"string": "APPLICATION MESSAGE ORIGIN PRIORITY", "string arrays": "APP_PARAMS CLI_COMMAND",
                "int": "OBJECT_ID OBSERVATION_ID", "double": "TIME"},
    "POINTING": {"string": "NAME", "int": "ANTENNA_ID NUM_POLY", "double": "INTERVAL TIME TIME_ORIGIN",
                 "double arrays": "DIRECTION TARGET", "boolean": "TRACKING"},
    "PROCESSOR": {"string": "SUB_TYPE TYPE", "int": "MODE_ID TYPE_ID", "boolean": "FLAG_ROW"},
}
_OPTIONAL = {"SOURCE"}
_OPTIONAL_COLUMNS = {"REST_FREQUENCY", "SYSVEL"}  # cells may be empty, too
_UNREAD = {"FEED", "FLAG_CMD", "HISTORY", "POINTING", "PROCESSOR"}  # may be long, and no image depends on them
_FREQUENCY_FRAMES = {*range(9), 64}  # REST to CMB, and Undefined
_LAST_CORRELATION = 32
_DIAMETER_M = 25.0
_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f]")


class _Rule(NamedTuple):
    """What a cell should hold: `right` takes the cell, others of its row by name, and numbers of rows by subtable.

    `instead` takes the others of its row and returns what stands for a wrong cell, which the image does not depend on.
    Without it a wrong cell is refused when selected data refer to it, and elsewhere the cell of a row that is right
    stands for it.
    """

    column: str
    words: str  # what the cell should hold, for the error message
    right: Callable[[np.ndarray, dict, dict], Any]
    instead: Callable[[dict], Any] | None = None


def _numbers(*shape):
    """Return the rule of a cell of finite numbers."""
    return lambda cell, row, counts: cell.shape == shape and np.isfinite(cell)


def _per_channel(right):
    """Return the rule of a cell with a number for each channel."""
    return lambda cell, row, counts: cell.ndim == 1 and cell.shape == np.shape(row["CHAN_FREQ"]) and right(cell)


def _directions(cell, row, counts):
    """A direction and its rates, as NUM_POLY has it."""
    return cell.shape == (2, int(row["NUM_POLY"]) + 1) and np.isfinite(cell)


def _row_of(table):
    """Return the rule of a row number of another subtable."""
    return lambda cell, row, counts: (cell >= 0) & (cell < counts[table])


def _size_of(column):
    """Return the rule of the number of cells in another column."""
    return lambda cell, row, counts: cell == np.size(row[column])


_RULES = {
    "ANTENNA": (
        _Rule("POSITION", "three finite numbers in m", _numbers(3)),
        _Rule("OFFSET", "three finite numbers in m", _numbers(3), lambda row: np.zeros(3)),
    ),
    "DATA_DESCRIPTION": (
        _Rule("SPECTRAL_WINDOW_ID", "a row of SPECTRAL_WINDOW", _row_of("SPECTRAL_WINDOW")),
        _Rule("POLARIZATION_ID", "a row of POLARIZATION", _row_of("POLARIZATION")),
    ),
    "FIELD": (
        _Rule("NUM_POLY", "0 or more", lambda cell, row, counts: cell >= 0),
        _Rule("PHASE_DIR", "2 by NUM_POLY + 1 finite numbers", _directions),
        _Rule("DELAY_DIR", "", _directions, lambda row: row["PHASE_DIR"]),
        _Rule("REFERENCE_DIR", "", _directions, lambda row: row["PHASE_DIR"]),
        _Rule("TIME", "", _numbers(), lambda row: np.zeros(())),
    ),
    "OBSERVATION": (_Rule("TIME_RANGE", "", _numbers(2), lambda row: np.zeros(2)),),
    "POLARIZATION": (
        _Rule("CORR_TYPE", "codes of correlations",
              lambda cell, row, counts: cell.ndim == 1 and cell.size and (cell > 0) & (cell <= _LAST_CORRELATION)),
        _Rule("NUM_CORR", "the number of correlations in CORR_TYPE", _size_of("CORR_TYPE")),
        _Rule("CORR_PRODUCT", "", lambda cell, row, counts: cell.shape == (2, np.size(row["CORR_TYPE"])) and cell >= 0,
              lambda row: np.zeros((2, np.size(row["CORR_TYPE"])), int)),
    ),
    "SPECTRAL_WINDOW": (
        _Rule("CHAN_FREQ", "a frequency in Hz for each channel",
              lambda cell, row, counts: cell.ndim == 1 and cell.size and np.isfinite(cell) & (cell > 0)),
        _Rule("CHAN_WIDTH", "a width in Hz for each channel",
              _per_channel(lambda cell: np.isfinite(cell) & (cell != 0))),
        _Rule("NUM_CHAN", "the number of channels in CHAN_FREQ", _size_of("CHAN_FREQ")),
        _Rule("MEAS_FREQ_REF", "the code of a frame", lambda cell, row, counts: int(cell) in _FREQUENCY_FRAMES),
        _Rule("EFFECTIVE_BW", "", _per_channel(np.isfinite), lambda row: np.abs(row["CHAN_WIDTH"])),
        _Rule("RESOLUTION", "", _per_channel(np.isfinite), lambda row: np.abs(row["CHAN_WIDTH"])),
        _Rule("REF_FREQUENCY", "", lambda cell, row, counts: np.isfinite(cell) & (cell > 0),
              lambda row: row["CHAN_FREQ"][0]),
        _Rule("TOTAL_BANDWIDTH", "", _numbers(), lambda row: np.abs(row["CHAN_WIDTH"]).sum()),
    ),
    "SOURCE": (
        _Rule("DIRECTION", "", _numbers(2), lambda row: np.zeros(2)),
        _Rule("PROPER_MOTION", "", _numbers(2), lambda row: np.zeros(2)),
        _Rule("TIME", "", _numbers(), lambda row: np.zeros(())),
        _Rule("INTERVAL", "", _numbers(), lambda row: np.zeros(())),
        _Rule("REST_FREQUENCY", "", lambda cell, row, counts: cell.ndim == 1 and np.isfinite(cell) & (cell > 0),
              lambda row: np.zeros(0)),
        _Rule("SYSVEL", "", lambda cell, row, counts: cell.ndim == 1 and np.isfinite(cell), lambda row: np.zeros(0)),
    ),
}


@dataclass
class _Subtables:
    """What is known of the subtables of one MeasurementSet.

    Attributes
    ----------
    name : str
    faults : dict
        (subtable, row) → what is wrong there with what the image depends on.
    repairs : dict
        Subtable → its cells to be set right: (column, row, value).
    folders : dict
        Temporary folders of the copies that CASA is shown, by whether all antennas have a diameter in it.
    """

    name: str
    faults: dict[tuple[str, int], str] = field(default_factory=dict)
    repairs: dict[str, list[tuple[str, int, Any]]] = field(default_factory=dict)
    folders: dict[bool, tempfile.TemporaryDirectory] = field(default_factory=dict)

    def path(self, diameters: bool) -> str:
        """Return the path that CASA is given."""
        repairs = _with_diameters(self) if diameters else self.repairs
        if not repairs:
            return self.name
        if diameters not in self.folders:
            self.folders[diameters] = _shown(self.name, repairs)
        return os.path.join(self.folders[diameters].name, os.path.basename(os.path.realpath(self.name)))


_known: dict[str, tuple[tuple, _Subtables]] = {}


def readable(name, diameters=False):
    """Return the path of a MeasurementSet that all CASA tools can read: `name`, unless its subtables are wrong.

    Parameters
    ----------
    name : str
        Path of the MeasurementSet.
    diameters : bool
        Give all antennas a diameter, without which CASA may make no primary beam.

    Raises
    ------
    ValueError
        A subtable lacks a column, or all its rows are wrong; the message names `vis`, subtable, column and row.
    """
    return _subtables(name).path(diameters)


def check_rows(name, **rows):
    """Raise unless the cells of these rows of the subtables are valid for imaging.

    Parameters
    ----------
    name : str
        Path of the MeasurementSet.
    **rows : sequence of int
        Row numbers by the name of the subtable.

    Raises
    ------
    ValueError
        With `vis`, subtable, column, row and what would be right.
    """
    faults = _subtables(name).faults
    for table, numbers in rows.items():
        for row in numbers:
            if (table, int(row)) in faults:
                raise ValueError(faults[table, int(row)])


def texts(name, table, column):
    """Return the texts in a column of a subtable, whatever their bytes; what is not UTF-8 is taken for Latin-1."""
    with opened("table", os.path.join(name, table)) as tb:
        return [_decoded(text) for text in tb.getcol(column)]


def _decoded(text):
    """Return a text as it was meant, given with one character for each byte, as `getcol` does."""
    try:
        return text if text.isascii() else text.encode("latin-1").decode("utf-8")
    except UnicodeError:
        return text


def _bearable(text):
    """Return a text, given with one character for each byte, as CASA bears it: UTF-8 without control characters."""
    return text if text.isascii() and text.isprintable() else _CONTROL.sub(" ", _decoded(text))


def _subtables(name):
    """Return the checked subtables of a MeasurementSet, checked again when one of its files has changed."""
    key, state = os.path.realpath(name), _state(name)
    if key not in _known or _known[key][0] != state:
        _known[key] = state, _examined(name)
    return _known[key][1]


def _state(name):
    """Return the names, sizes and times of the files of the subtables, and the names of those of the main table."""
    state = [sorted(os.listdir(name)), os.stat(os.path.join(name, "table.dat")).st_mtime_ns]
    for table in _COLUMNS:
        folder = os.path.join(name, table)
        if os.path.isdir(folder):
            with os.scandir(folder) as entries:
                state += sorted((entry.path, entry.stat().st_size, entry.stat().st_mtime_ns)
                                for entry in entries if entry.name != "table.lock")
    return tuple(map(str, state))


def _examined(name):
    """Examine all subtables, and make a copy of those that are wrong."""
    found, counts = _Subtables(name), {}
    with opened("table", name) as tb:
        tables = [table for table in _COLUMNS if table not in _OPTIONAL or table in tb.keywordnames()]
    for table in tables:
        if not os.path.isdir(os.path.join(name, table)):
            raise ValueError(f"vis = '{name}': the subtable {table} is missing")
        with opened("table", os.path.join(name, table)) as tb:
            _check_columns(name, table, tb)
            counts[table] = tb.nrows()
    for table in (table for table in tables if table not in _UNREAD):
        with opened("table", os.path.join(name, table)) as tb:
            _examine(found, table, tb, counts)
    return found


def _check_columns(name, table, tb):
    """Raise unless the columns of a subtable are there, of the right type."""
    described = tb.getdesc()
    for kind, columns in _COLUMNS[table].items():
        for column in columns.split():
            if column not in described:
                if column in _OPTIONAL_COLUMNS:
                    continue
                raise ValueError(f"vis = '{name}': {table} has no column {column}, which every MeasurementSet has")
            one = described[column]
            held = one["valueType"].lower() + (" arrays" if "ndim" in one else "")
            if held != kind:
                raise ValueError(f"vis = '{name}': {table}/{column} holds {held}: should be {kind}")


def _examine(found, table, tb, counts):
    """Note the wrong cells of one subtable, and what to put in their places."""
    texts_of = {column: tb.getcol(column) for column in _COLUMNS[table].get("string", "").split()}
    repairs = [(column, row, _bearable(text)) for column, cells in texts_of.items()
               for row, text in enumerate(cells) if _bearable(text).encode() != text.encode("latin-1")]
    rules = [rule for rule in _RULES.get(table, ()) if rule.column in tb.colnames()]
    cells = {rule.column: _cells(tb, rule.column) for rule in rules}
    rows = [{column: cells[column][row] for column in cells} for row in range(tb.nrows())]
    needed, others = [[rule for rule in rules if (rule.instead is None) == bare] for bare in (True, False)]
    broken = [row for row, of_row in enumerate(rows) if not all(_is_right(rule, of_row, counts) for rule in needed)]
    for row in broken:
        rule = next(rule for rule in needed if not _is_right(rule, rows[row], counts))
        found.faults[table, row] = f"vis = '{found.name}': {table}/{rule.column} of row {row} holds " \
            f"{_spelled(rows[row][rule.column])}: should be {rule.words}"
    whole = next((row for row in range(len(rows)) if row not in set(broken)), None)
    if broken and whole is None:
        raise ValueError(found.faults[table, 0])
    for row in broken:
        rows[row] |= {rule.column: rows[whole][rule.column] for rule in needed}
        repairs += [(rule.column, row, rows[row][rule.column]) for rule in needed]
    for row, of_row in enumerate(rows):
        repairs += [(rule.column, row, rule.instead(of_row)) for rule in others if not _is_right(rule, of_row, counts)]
    if repairs:
        found.repairs[table] = repairs


def _cells(tb, column):
    """Return the cell of every row as an array, None where it is empty."""
    return [np.asarray(tb.getcell(column, row)) if tb.iscelldefined(column, row) else None for row in range(tb.nrows())]


def _is_right(rule, row, counts):
    cell = row[rule.column]
    if cell is None:
        return rule.column in _OPTIONAL_COLUMNS
    return bool(np.all(rule.right(cell, row, counts)))


def _spelled(cell):
    """Spell a wrong cell for a message."""
    if cell is None:
        return "nothing"
    bad = cell[~np.isfinite(cell)]
    return str(bad.flat[0]) if bad.size else str(cell.tolist())[:60]


def _with_diameters(found):
    """Return the repairs, and a diameter for every antenna."""
    with opened("table", os.path.join(found.name, "ANTENNA")) as tb:
        diameters = [("DISH_DIAMETER", row, _DIAMETER_M) for row in range(tb.nrows())]
    return found.repairs | {"ANTENNA": found.repairs.get("ANTENNA", []) + diameters}


def _shown(name, repairs):
    """Return a temporary folder with links to the MeasurementSet and corrected copies of the wrong subtables."""
    folder = tempfile.TemporaryDirectory(prefix="casa_sara_")
    source = os.path.realpath(name)
    shown = os.path.join(folder.name, os.path.basename(source))
    os.mkdir(shown)
    for entry in os.listdir(source):
        path, copy = os.path.join(source, entry), os.path.join(shown, entry)
        if entry in repairs:
            shutil.copytree(path, copy, copy_function=shutil.copyfile)
        elif entry == "table.lock":  # of this process alone
            shutil.copyfile(path, copy)
        else:
            os.symlink(path, copy)
    for table, cells in repairs.items():
        with opened("table", os.path.join(shown, table), nomodify=False) as tb:
            for column, row, value in cells:
                tb.putcell(column, row, value if isinstance(value, str) or np.ndim(value) else np.asarray(value).item())
    return folder
