"""The cells of a MeasurementSet's main table: which there are, and whether their shapes fit its subtables.

casacore ends the process where a slice is read of a cell that is too small. So the shapes are looked at before any
cell is read. A tiled storage manager knows the shapes that it holds, which settles most columns without a look at a
row; the rows of other columns are sifted by TaQL: 0.05 s for a million of them, 0.5 s in a column that is not tiled.
"""

from __future__ import annotations

import math
import os
import tempfile

import numpy as np

__all__ = ["first_misfit", "lacking_cells", "read_slice"]

_DIRECT = 1  # bit of a column's options: every row holds a cell


def lacking_cells(tb, name, wanted):
    """Return the rows that hold no cell, or one without elements, of array columns.

    Parameters
    ----------
    tb : casatools.table
        The main table of the MeasurementSet `name`, open.
    name : str
        Path of the MeasurementSet.
    wanted : dict
        Data description → its rows (int64, increasing), and a dict: column → shape (tuple of int) of its cells.

    Returns
    -------
    dict
        Data description → dict: column → int64, row numbers, increasing; all rows where the table has no such column.
        Columns of which all rows hold cells are left out.

    Raises
    ------
    ValueError
        A cell has another shape.
    """
    alike = {}
    for dd, (_, shapes) in wanted.items():
        alike.setdefault(tuple(shapes.items()), []).append(dd)
    there, tiles = set(tb.colnames()), _tiled_shapes(tb)
    lacking = {dd: {column: rows for column in shapes if column not in there} for dd, (rows, shapes) in wanted.items()}
    for shapes, dds in alike.items():
        doubts = {column: _doubt(tb, column, shape, tiles) for column, shape in shapes if column in there}
        doubts = {column: doubt for column, doubt in doubts.items() if doubt}
        # one look for all columns, and one at each only where something is odd
        if doubts and _rows_where(tb, " || ".join(doubts.values()), dds).size:
            for column, doubt in doubts.items():
                rows = np.concatenate([wanted[dd][0] for dd in dds])
                odd = np.intersect1d(_rows_where(tb, doubt, dds), rows)
                none = np.intersect1d(_rows_where(tb, f"!isdefined({column}) || nelements({column}) == 0", dds), odd)
                wrong = np.setdiff1d(odd, none)
                if wrong.size:
                    raise ValueError(f"vis = '{name}': {_words(tb, column, wrong[0], dict(shapes)[column])}, as "
                                     "SPECTRAL_WINDOW and POLARIZATION say of its data description")
                for dd in dds if none.size else ():
                    lacking[dd][column] = np.intersect1d(none, wanted[dd][0], assume_unique=True)
    return lacking


def first_misfit(tb, column, shape):
    """Return what is wrong with the first cell of a column that has not this shape, or is missing; '' if none."""
    doubt = _doubt(tb, column, shape, _tiled_shapes(tb))
    odd = _rows_where(tb, doubt) if doubt else np.arange(0)
    return _words(tb, column, odd.min(), shape) if odd.size else ""


def _words(tb, column, row, shape):
    """Return what is wrong with a cell."""
    defined = tb.iscelldefined(column, int(row))
    found = f"has the shape {list(np.shape(tb.getcell(column, int(row))))}" if defined else "is undefined"
    return f"{column} of row {row} {found}: should have the shape {list(shape)}"


def _doubt(tb, column, shape, tiles):
    """Return the TaQL condition of all rows whose cells may have another shape; '' where it is clear that none has."""
    description = tb.getcoldesc(column)
    if "shape" in description and tuple(description["shape"]) != shape:
        return "TRUE"
    if "shape" in description and description["option"] & _DIRECT:
        return ""
    held, count = tiles.get(column, (set(), 0))
    all_held = count == tb.nrows()  # else some rows have no cells, or are in other tables, as virtualconcat leaves them
    if held == {shape} and all_held:
        return ""
    size = f"nelements({column}) != {math.prod(shape)}"
    if all_held and not any(math.prod(one) == math.prod(shape) for one in held - {shape}):
        return size
    # with the number of elements all lengths but one tell the shape; TaQL's order of axes is the other one
    axes = [f"shape({column})[{axis}] != {length}" for axis, length in enumerate(shape[:0:-1])]
    return " || ".join([size, f"ndim({column}) != {len(shape)}", *axes])


def _tiled_shapes(tb):
    """Return for each tiled column of one table of several the set of its cells' shapes, and their number."""
    tiles = {}
    for manager in tb.getdminfo().values():
        if "HYPERCUBES" in manager["SPEC"]:
            cubes = manager["SPEC"]["HYPERCUBES"].values()
            shapes = {tuple(cube["CellShape"].tolist()) for cube in cubes}
            tiles |= dict.fromkeys(manager["COLUMNS"], (shapes, sum(int(cube["CubeShape"][-1]) for cube in cubes)))
    return tiles


def _rows_where(tb, condition, dds=None):
    """Return the numbers of a table's rows, or those of some data descriptions, that fulfil a TaQL condition."""
    if dds is not None:
        condition = f"DATA_DESC_ID IN {dds} && ({condition})"
    with tempfile.TemporaryDirectory(prefix="casa_sara_") as folder:
        link = os.path.join(folder, "table")  # TaQL does not take all names that files may have
        os.symlink(tb.name(), link)
        found = tb.taql(f"SELECT FROM '{link}' WHERE {condition}")
        try:
            return found.rownumbers() if found.nrows() else np.arange(0)
        finally:
            found.close()


def read_slice(part, column, there, low, high, dtype):
    """Return a slice of the cells of all rows of a table, (…, R), 0 where there is none.

    Parameters
    ----------
    part : casatools.table
        R rows.
    column : str
        Name of the column.
    there : bool (R,)
        Whether a row holds a cell.
    low, high : list of int
        First and last index on each axis.
    dtype
        Of the result where there is no cell at all.
    """
    step = [1] * len(low)
    if there.all():
        return part.getcolslice(column, low, high, step)
    shape = [last - first + 1 for first, last in zip(low, high)]
    values = np.zeros((*shape, there.size), dtype)
    if there.any():
        some = part.selectrows(np.flatnonzero(there).tolist())
        try:
            values[..., there] = some.getcolslice(column, low, high, step)
        finally:
            some.close()
    return values
