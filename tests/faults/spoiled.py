"""A small observation, and every way in which its MeasurementSet is spoiled here.

FAULTS are wrong numbers, each with the samples that are wrong; HOPELESS leaves nothing to image; BROKEN are
MeasurementSets that are none any more. Each is a function of the path of a copy that it spoils.
"""

import os
import shutil

import numpy as np
from simulated_ms import _tool, column, edit, simulate

ARCSEC = np.radians(1 / 3600)
SKY = ((1.0, -5 * ARCSEC, 7 * ARCSEC), (0.5, 8 * ARCSEC, -3 * ARCSEC))
ROW, CHANNEL = 40, 1  # of what is spoiled
GRID = dict(imsize=64, cell="1arcsec", datacolumn="data")


def observe(path, **changes):
    """Write 28 baselines in 12 integrations, three channels and two hands."""
    return simulate(path, **(dict(configuration="c", antennas=8, sky=SKY, noise=0.02) | changes))


def put(col, where, value):
    """Return a function that sets a part of a column of a MeasurementSet."""

    def spoil(name):
        values = column(name, col)
        values[where] = value
        edit(name, col, lambda old: values)

    return spoil


SAMPLE, CORRELATION = (slice(None), CHANNEL, ROW), (0, CHANNEL, ROW)
OF_ROW, ONE_CHANNEL = (..., ROW), (slice(None), CHANNEL)


def flag(where):
    """Return a function that flags samples [correlation, channel, row]."""
    return put("FLAG", where, True)


FAULTS = {  # name: (what spoils, the samples to flag instead)
    **{f"one visibility {value}": (put("DATA", CORRELATION, value), SAMPLE)
       for value in (np.nan, np.inf, 1j * np.nan, 1e10, 1e30, 3e38)},
    **{f"one weight {value}": (put("WEIGHT", (0, ROW), value), OF_ROW)
       for value in (np.inf, 1e12, 1e30, 3e38)},
    **{f"weights of one row {value}": (put("WEIGHT", OF_ROW, value), OF_ROW) for value in (np.nan, 0.0, -1.0)},
    **{f"uvw of one row {value}": (put("UVW", OF_ROW, value), OF_ROW) for value in (np.nan, np.inf, 1e12, 1e300, 0.0)},
    **{f"one channel {value}": (put("DATA", ONE_CHANNEL, value), ONE_CHANNEL) for value in (np.nan, 1e12, 1e30)},
}
HOPELESS = {  # nothing is left, or nothing to image
    "all flagged": flag(...),
    "all rows flagged": put("FLAG_ROW", ..., True),
    "all weights zero": put("WEIGHT", ..., 0.0),
    "all weights negative": put("WEIGHT", ..., -1.0),
    "all weights 1e-38": put("WEIGHT", ..., 1e-38),
    "all uvw zero": put("UVW", ..., 0.0),
    "all data NaN": put("DATA", ..., np.nan),
    "all data zero": put("DATA", ..., 0.0),
    "all data 1e38": put("DATA", ..., 1e38),
}


def cut(path, fraction=0.5):
    """Return a function that truncates a file of a MeasurementSet."""

    def spoil(name):
        path_ = os.path.join(name, path)
        os.truncate(path_, int(os.path.getsize(path_) * fraction))

    return spoil


def garble(path, seed):
    """Return a function that overwrites one byte in a hundred of a file of a MeasurementSet."""

    def spoil(name):
        path_ = os.path.join(name, path)
        with open(path_, "rb") as file:
            content = np.frombuffer(file.read(), np.uint8).copy()
        rng = np.random.default_rng(seed)
        content[rng.integers(0, content.size, content.size // 100)] = rng.integers(0, 256, content.size // 100)
        with open(path_, "wb") as file:
            file.write(content.tobytes())

    return spoil


def without(subtable):
    return lambda name: shutil.rmtree(os.path.join(name, subtable))


def lacking(col, subtable=""):
    def spoil(name):
        tb = _tool("table")
        tb.open(os.path.join(name, subtable), nomodify=False)
        try:
            _drop(tb, col)
        finally:
            tb.close()

    return spoil


def _drop(tb, col):
    """Remove a column of an open table, or give it another name where its storage manager lets none go."""
    try:
        tb.removecols([col])
    except RuntimeError:
        tb.renamecol(col, "OLD_" + col)


def put_in(subtable, col, value):
    return lambda name: edit(os.path.join(name, subtable), col, lambda old: np.full_like(old, value))


SUBTABLES = ("ANTENNA", "DATA_DESCRIPTION", "FEED", "FIELD", "OBSERVATION", "POLARIZATION", "SPECTRAL_WINDOW")
BROKEN = {
    **{f"table.dat cut to {fraction}": cut("table.dat", fraction) for fraction in (0, 0.5, 0.99)},
    **{f"table.dat garbled {seed}": garble("table.dat", seed) for seed in range(4)},
    "column file cut": cut("table.f2"),
    "data file cut": cut("table.f2_TSM1"),
    **{f"no {name}": without(name) for name in SUBTABLES},
    **{f"{name} cut": cut(f"{name}/table.f0") for name in SUBTABLES},
    "no column FLAG": lacking("FLAG"),
    "no column WEIGHT": lacking("WEIGHT"),
    "no column DATA": lacking("DATA"),
    "no column CHAN_FREQ": lacking("CHAN_FREQ", "SPECTRAL_WINDOW"),
    "frequencies NaN": put_in("SPECTRAL_WINDOW", "CHAN_FREQ", np.nan),
    "frequencies zero": put_in("SPECTRAL_WINDOW", "CHAN_FREQ", 0.0),
    "field direction NaN": put_in("FIELD", "PHASE_DIR", np.nan),
    "times NaN": put("TIME", ..., np.nan),
    "one time NaN": put("TIME", ROW, np.nan),
    "field number beyond the table": put("FIELD_ID", ..., 5),
    "antenna number beyond the table": put("ANTENNA2", ROW, 50),
}


# Cells: columns written anew, cell by cell -------------------------------------------------------


def remake(col, change, manager="StandardStMan", **description):
    """Return a function that writes a column of a MeasurementSet (or of `NAME.ms/SUBTABLE`) anew, cell by cell.

    Parameters
    ----------
    col : str
    change : callable
        Takes the list of cells, None where one is undefined, and returns the new list.
    manager : str
        Storage manager of the new column: 'StandardStMan', 'TiledShapeStMan', 'TiledColumnStMan', 'IncrementalStMan'.
    **description
        Entries of the column's description that change: valueType, ndim (0 makes a scalar column), shape.
    """

    def spoil(name):
        tb = _tool("table")
        tb.open(str(name), nomodify=False)
        try:
            cells = change([tb.getcell(col, row) if tb.iscelldefined(col, row) else None for row in range(tb.nrows())])
            old = tb.getcoldesc(col)
            new = {key: old[key] for key in ("valueType", "comment", "keywords", "ndim") if key in old} | description
            new = {key: value for key, value in new.items() if (key, value) != ("ndim", 0)}
            new |= dict(option=4 if "shape" in new else 0, maxlen=0, dataManagerType=manager,
                        dataManagerGroup="new_" + col)
            tiles = dict(DEFAULTTILESHAPE=[2] * new.get("ndim", 0) + [16])
            _drop(tb, col)
            tb.addcols({col: new},
                       dict(TYPE=manager, NAME="new_" + col, SPEC=tiles if manager.startswith("Tiled") else {}))
            for row, cell in enumerate(cells):
                if cell is not None:
                    tb.putcell(col, row, cell)
        finally:
            tb.close()

    return spoil


def cells(col, rows, change, **options):
    """Return a function that changes the cells of these rows (all where None) of a column; `change` may return None."""
    return remake(col,
                  lambda old: [change(cell) if rows is None or row in rows else cell for row, cell in enumerate(old)],
                  **options)


def undefined(col, rows=None, **options):
    """Return a function that takes the cells of these rows (all where None) out of a column."""
    return cells(col, rows, lambda cell: None, **options)


def shaped(col, rows, shape, /, **options):
    """Return a function that gives the cells of these rows (all where None) another shape."""
    return cells(col, rows, lambda cell: np.resize(cell, shape), **options)


FAULTS |= {
    f"{col} undefined in one row, {manager}": (undefined(col, [ROW], manager=manager), OF_ROW)
    for col in ("DATA", "FLAG", "WEIGHT") for manager in ("StandardStMan", "TiledShapeStMan")
} | {"DATA empty in one row": (cells("DATA", [ROW], lambda cell: cell[:, :0]), OF_ROW)}
BROKEN |= {
    "DATA with a channel less in one row": shaped("DATA", [ROW], (2, 2)),
    "DATA with a channel less in all rows": shaped("DATA", None, (2, 2), manager="TiledColumnStMan", shape=[2, 2]),
    "FLAG with a channel more": shaped("FLAG", None, (2, 4), manager="TiledShapeStMan"),
    "FLAG with channels for correlations in one row": shaped("FLAG", [ROW], (3, 2), manager="TiledShapeStMan"),
    "WEIGHT of one correlation": shaped("WEIGHT", None, (1,)),
    "SIGMA of three correlations in one row": shaped("SIGMA", [ROW], (3,), manager="TiledShapeStMan"),
    "UVW undefined in one row": undefined("UVW", [ROW]),
    "WEIGHT in double precision": remake("WEIGHT", lambda old: old, valueType="double"),
    "DATA in double precision": remake("DATA", lambda old: old, valueType="dcomplex"),
    "DATA undefined in all rows": undefined("DATA"),
    "no column TIME": lacking("TIME"),
    "one time not filled": put("TIME", ROW, 0.0),
    "one interval 1e30 s": put("INTERVAL", ROW, 1e30),
    "negative antenna number": put("ANTENNA1", ROW, -1),
    "data description beyond the table": put("DATA_DESC_ID", ROW, 7),
    "observation number beyond the table": put("OBSERVATION_ID", ROW, 7),
}
