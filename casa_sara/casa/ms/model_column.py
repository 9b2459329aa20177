"""The model image's visibilities into MODEL_DATA, for self-calibration.

This is the only place where a user's MeasurementSet is changed, so it comes last in a run
and is checked before: `check_model_column_writable` can be called before hours are spent.

A child process writes it, because CASA ends a process that finds the disk full. While a column is written the
file MODEL_DATA.incomplete stands in its MeasurementSet, to which CASA pays no attention. A run that is killed leaves
it there.
"""

from __future__ import annotations

import errno
import os
import shutil
import socket
import zlib
from datetime import datetime, timezone
from pathlib import Path

import numpy as np

from casa_sara.casa.ms.frames import Geometry
from casa_sara.casa.ms.selection import select_data
from casa_sara.casa.ms.subtables import readable
from casa_sara.casa.ms.table_cells import lacking_cells
from casa_sara.casa.runtime.child_process import ChildError, in_child
from casa_sara.casa.runtime.tools import opened
from casa_sara.data.visibilities import RowTable
from casa_sara.runtime.signals import signals_deferred

__all__ = [
    "INCOMPLETE", "check_model_column_writable", "incomplete_columns", "save_model_column", "write_model_column",
]

INCOMPLETE = "MODEL_DATA.incomplete"
_COLUMN = "MODEL_DATA"
_CHUNK = 1_000_000  # visibilities predicted at a time
_SPARE, _OVERHEAD = 1.05, 200_000  # of the disk space computed; bytes for descriptions of tables, which CASA rewrites


def check_model_column_writable(selection):
    """Raise unless the model column of every selected MeasurementSet can be written.

    Parameters
    ----------
    selection : casa_sara.options.Selection
        The MeasurementSets and the data selected in them.

    Raises
    ------
    PermissionError
        A MeasurementSet is write-protected.
    OSError
        The disk has no room for the column.
    ValueError
        There is a column, but not with a cell of the right shape in every selected row.
    """
    needed = {}
    for ms in select_data(selection)[0]:
        _check_cells(ms)
        for folder, _, names in os.walk(ms.name):
            for path in [folder] + [os.path.join(folder, name) for name in names]:
                if not os.access(path, os.W_OK):
                    raise PermissionError(
                        f"savemodel = 'modelcolumn' writes into vis = '{ms.name}', but '{path}' is write-protected: "
                        "make it writable, or set savemodel = 'none'"
                    )
        device = os.stat(ms.name).st_dev
        bytes_so_far, _ = needed.get(device, (0, None))
        needed[device] = bytes_so_far + _column_bytes(ms.name), ms.name
    for count, name in needed.values():
        _check_space(name, count)


def _check_cells(ms):
    """Raise where a model column has no cell, or one of another shape, in a selected row: the user may remove it."""
    with opened("table", ms.name) as tb:
        if _COLUMN not in tb.colnames():
            return
        wanted = {group.dd: (group.rows, {_COLUMN: group.cell_shape}) for group in ms.groups}
        try:
            lacking = [rows[0] for columns in lacking_cells(tb, ms.name, wanted).values() for rows in columns.values()]
            if lacking:
                raise ValueError(f"vis = '{ms.name}': {_COLUMN} of row {min(lacking)} is empty")
        except ValueError as error:
            raise ValueError(f"savemodel = 'modelcolumn': {error}; casatasks.delmod(vis={ms.name!r}, otf=False, "
                             f"scr=True) removes {_COLUMN}, and tsara then writes a new one; or set "
                                 "savemodel = 'none'") from error


def _check_space(name, count):
    """Raise unless the disk of a MeasurementSet has room for columns to be added, of so many bytes."""
    needed, free = count * _SPARE + _OVERHEAD, shutil.disk_usage(name).free
    if needed > free:
        raise OSError(
            errno.ENOSPC, f"savemodel = 'modelcolumn' needs {needed / 1e6:.1f} MB for {_COLUMN}, but the disk of "
            f"'{name}' has {free / 1e6:.1f} MB left: free some, or set savemodel = 'none'"
        )


def incomplete_columns(vis):
    """Return which of these MeasurementSets have an incomplete model column of a killed run."""
    return [name for name in vis if os.path.exists(os.path.join(name, INCOMPLETE))]


def _column_bytes(name):
    """Return the size of the column to be added: complex64, all rows, channels and correlations."""
    with opened("table", name) as tb:
        if _COLUMN in tb.colnames():
            return 0
        rows = np.bincount(tb.getcol("DATA_DESC_ID"))
    with opened("msmetadata", readable(name)) as md:
        cells = [
            md.nchan(md.spwfordatadesc(dd)) * len(md.corrtypesforpol(md.polidfordatadesc(dd)))
            for dd in range(rows.size)
        ]
    return 8 * int(rows @ np.array(cells))


def write_model_column(selection, phase_center, predict, by_row=False):
    """Fill MODEL_DATA of the selected rows and channels, flagged ones too.

    The model visibility is the same for both parallel-hand correlations (unpolarised) and 0 for cross-hand ones.
    Any model kept in the header (usescratch=False) is deleted, so that it does not go first.
    A column that is there keeps what it holds outside the selection; a new one holds
    CASA's default of 1 there. SIGINT and SIGTERM wait until the column is whole and has been read back.

    Parameters
    ----------
    selection : casa_sara.options.Selection
        The MeasurementSets and the data selected in them.
    phase_center : dict
        Direction of the image centre, `Visibilities.phase_center`.
    predict : callable
        Takes uvw float64 (3, M) in wavelengths and LSRK frequencies (M,) in Hz, and returns the complex (M,)
        visibilities in Jy of the model image, at the image's phase centre.
    by_row : bool
        It takes the `RowTable` of the R rows too, whose M/R channels follow one another.

    Raises
    ------
    RuntimeError
        When what is read back is not what was written.
    """
    for ms in select_data(selection)[0]:
        with signals_deferred():
            _mark(ms.name)
            with opened("calibrater", ms.name, addcorr=False, addmodel=True) as cb:
                cb.delmod(otf=True, scr=False)
            written = _write(ms, Geometry(ms, phase_center), predict, by_row)
            if written != [_checksum(values) for values in _read_back(ms)]:
                raise RuntimeError(f"{_COLUMN} of '{ms.name}' does not read back as it was written: do not use it")
            os.unlink(os.path.join(ms.name, INCOMPLETE))


def _mark(name):
    """Say in the MeasurementSet that its model column is not to be used."""
    since = datetime.now(timezone.utc).isoformat(" ", "seconds")
    Path(name, INCOMPLETE).write_text(
        f"Process {os.getpid()} on {socket.gethostname()} began to write {_COLUMN} at {since}. Where it has ended, the "
        "column is incomplete: tsara with restart=True, niter=0, savemodel='modelcolumn' writes it again.\n",
        encoding="utf-8")


def save_model_column(vis, write, **request):
    """Have a child process write the model columns, signals deferred.

    Until a column has been added whole, the description of its table is the old one, and new files beside it belong to
    nothing: they are removed when the child fails. Where this process holds a MeasurementSet open elsewhere a
    child would wait for it forever, and this process writes.

    Parameters
    ----------
    vis : sequence of str
        The MeasurementSets.
    write : callable
        Calls `write_model_column`: at the top level of a module, for the child process.
    **request
        Its arguments.

    Raises
    ------
    OSError
        A disk has no room; the message says which MeasurementSets hold an unfinished column, if any.
    RuntimeError
        For anything else that the child could not do.
    """
    missing = {name: _column_bytes(name) for name in vis}
    for name, count in missing.items():
        _check_space(name, count)
    before = {name: (set(os.listdir(name)), Path(name, "table.dat").read_bytes()) for name in vis if missing[name]}
    with signals_deferred():
        if any(map(_held_open, vis)):
            write(**request)
            return
        try:
            in_child(write, **request)
        except ChildError as error:
            full = any(shutil.disk_usage(name).free < _OVERHEAD for name in vis)
            for name, state in before.items():
                _clear_away(name, *state)
            left = incomplete_columns(vis)
            states = f"{_COLUMN} of {', '.join(left)} is incomplete; restart=True, niter=0 finishes it" if left \
                else "the MeasurementSets are as they were"
            words = f"savemodel = 'modelcolumn': {_COLUMN} could not be written"
            if full:
                raise OSError(errno.ENOSPC, f"{words}, the disk is full: {error}; {states}") from error
            raise RuntimeError(f"{words}: {error}; {states}") from error


def _clear_away(name, files, description):
    """Remove what is left of a column that was not added."""
    if Path(name, "table.dat").read_bytes() == description:
        for file in set(os.listdir(name)) - files:
            if file.startswith("table.") or file == INCOMPLETE:
                os.unlink(os.path.join(name, file))


def _held_open(name):
    """Return whether this process has files of a MeasurementSet open, as far as the system reports it."""
    folder, files = os.path.realpath(name) + os.sep, "/proc/self/fd"
    opened_files = os.listdir(files) if os.path.isdir(files) else ()
    return any(os.path.realpath(os.path.join(files, file)).startswith(folder) for file in opened_files)


def _pieces(ms):
    """Yield (group, rows) of the pieces in which the column is written."""
    for group in ms.groups:
        count = max(1, _CHUNK // group.channels.size)
        for start in range(0, group.rows.size, count):
            yield group, group.rows[start : start + count]


def _corners(group):
    """Return the slice of the column's cells that holds the selected channels."""
    return [0, int(group.channels[0])], [len(group.correlations) - 1, int(group.channels[-1])], [1, 1]


def _write(ms, geometry, predict, by_row):
    """Write all pieces and return their checksums."""
    checksums = []
    with opened("table", ms.name, nomodify=False) as tb:
        for group, rows in _pieces(ms):
            part = tb.selectrows(rows.tolist())
            try:
                uvw_m = part.getcol("UVW")
                usable = np.isfinite(uvw_m).all(axis=0)
                model = np.zeros((rows.size, group.channels.size), dtype=complex)
                field, time = part.getcol("FIELD_ID")[usable], part.getcol("TIME")[usable]
                freq_hz = geometry.frequencies(group, field, time)
                rows_too = [_row_table(ms, group, part, rows, usable)] if by_row else []
                model[usable] = _at_field_centre(predict, freq_hz, rows_too,
                                                 *geometry.wavelengths(group, field, time, uvw_m[:, usable]))
                values = part.getcolslice(_COLUMN, *_corners(group))
                selected = np.zeros((values.shape[0], group.channels.size, rows.size), dtype=complex)
                selected[_parallel(group)] = model.T
                values[:, group.channels - group.channels[0]] = selected
                part.putcolslice(_COLUMN, values, *_corners(group))
            finally:
                part.close()
            checksums.append(_checksum(values))
    return checksums


def _parallel(group):
    """Return the positions of the parallel-hand correlations."""
    return [k for k, name in enumerate(group.correlations) if name in ("I", "RR", "LL", "XX", "YY")]


def _row_table(ms, group, part, rows, usable):
    """Return the RowTable of the usable rows of a piece."""
    names = {"time": "TIME", "interval": "INTERVAL", "scan": "SCAN_NUMBER", "observation": "OBSERVATION_ID",
             "field": "FIELD_ID", "antenna1": "ANTENNA1", "antenna2": "ANTENNA2"}
    columns = {name: part.getcol(column)[usable] for name, column in names.items()}
    of_group = {name: np.full(np.count_nonzero(usable), value)
                for name, value in (("ms", ms.number), ("spw", group.spw), ("hands", len(group.hands)))}
    return RowTable(row=rows[usable], **columns, **of_group)


def _at_field_centre(predict, freq_hz, rows_too, uvw, shift):
    """Predict, and turn the visibilities back from the image's phase centre to the field's."""
    model = np.asarray(predict(uvw.reshape(3, -1), freq_hz.reshape(-1), *rows_too)).reshape(uvw.shape[1:])
    return model if shift is None else model * np.exp(2j * np.pi * shift)


def _read_back(ms):
    """Yield the pieces as they are on disk."""
    with opened("table", ms.name) as tb:
        for group, rows in _pieces(ms):
            part = tb.selectrows(rows.tolist())
            try:
                yield part.getcolslice(_COLUMN, *_corners(group))
            finally:
                part.close()


def _checksum(values):
    """Return the CRC of complex values in the column's single precision."""
    return zlib.crc32(np.asfortranarray(values, dtype=np.complex64).tobytes(order="F"))
