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
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from casa_sara.casa.ms.subtable_rules import COLUMNS, DIAMETER_M, OPTIONAL, OPTIONAL_COLUMNS, RULES, UNREAD
from casa_sara.casa.runtime.tools import opened

__all__ = ["check_rows", "readable", "texts"]

_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f]")


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
    for table in COLUMNS:
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
        tables = [table for table in COLUMNS if table not in OPTIONAL or table in tb.keywordnames()]
    for table in tables:
        if not os.path.isdir(os.path.join(name, table)):
            raise ValueError(f"vis = '{name}': the subtable {table} is missing")
        with opened("table", os.path.join(name, table)) as tb:
            _check_columns(name, table, tb)
            counts[table] = tb.nrows()
    for table in (table for table in tables if table not in UNREAD):
        with opened("table", os.path.join(name, table)) as tb:
            _examine(found, table, tb, counts)
    return found


def _check_columns(name, table, tb):
    """Raise unless the columns of a subtable are there, of the right type."""
    described = tb.getdesc()
    for kind, columns in COLUMNS[table].items():
        for column in columns.split():
            if column not in described:
                if column in OPTIONAL_COLUMNS:
                    continue
                raise ValueError(f"vis = '{name}': {table} has no column {column}, which every MeasurementSet has")
            one = described[column]
            held = one["valueType"].lower() + (" arrays" if "ndim" in one else "")
            if held != kind:
                raise ValueError(f"vis = '{name}': {table}/{column} holds {held}: should be {kind}")


def _examine(found, table, tb, counts):
    """Note the wrong cells of one subtable, and what to put in their places."""
    texts_of = {column: tb.getcol(column) for column in COLUMNS[table].get("string", "").split()}
    repairs = [(column, row, _bearable(text)) for column, cells in texts_of.items()
               for row, text in enumerate(cells) if _bearable(text).encode() != text.encode("latin-1")]
    rules = [rule for rule in RULES.get(table, ()) if rule.column in tb.colnames()]
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
        return rule.column in OPTIONAL_COLUMNS
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
        diameters = [("DISH_DIAMETER", row, DIAMETER_M) for row in range(tb.nrows())]
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
