"""The model image's visibilities into MODEL_DATA, for self-calibration.

This is the only place where a user's MeasurementSet is changed, so it comes last in a run
and is checked before: `check_model_column_writable` can be called before hours are spent.

While a column is written the file MODEL_DATA.incomplete stands in its MeasurementSet, to which
CASA pays no attention. A run that is killed leaves it there.
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

from casa_sara.casa.child import ChildError, in_child
from casa_sara.casa.frames import Geometry
from casa_sara.casa.selection import select_data
from casa_sara.casa.tools import opened
from casa_sara.interrupt import signals_deferred

__all__ = ["INCOMPLETE", "add_column", "check_model_column_writable", "incomplete_columns", "write_model_column"]

INCOMPLETE = "MODEL_DATA.incomplete"
_COLUMN = "MODEL_DATA"
_CHUNK = 1_000_000  # visibilities predicted at a time
_SPARE, _OVERHEAD = 1.05, 200_000  # of the disk space computed; bytes for the table's description, locks and the mark


def check_model_column_writable(selection):
    """Raise unless the model column of every selected MeasurementSet can be written.

    Parameters
    ----------
    selection : casa_sara.options.Selection

    Raises
    ------
    PermissionError
        A MeasurementSet is write-protected.
    OSError
        The disk has no room for the column.
    """
    needed = {}
    for ms in select_data(selection)[0]:
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


def _check_space(name, count):
    """Raise unless the disk of a MeasurementSet has room for columns to be added, of so many bytes."""
    needed, free = count and count * _SPARE + _OVERHEAD, shutil.disk_usage(name).free
    if needed > free:
        raise OSError(
            errno.ENOSPC, f"savemodel = 'modelcolumn' needs {needed / 1e6:.1f} MB for {_COLUMN}, but the disk of "
            f"'{name}' has {free / 1e6:.1f} MB left: free some, or set savemodel = 'none'"
        )


def incomplete_columns(vis):
    """Return which of these MeasurementSets hold a model column that a killed run left half written."""
    return [name for name in vis if os.path.exists(os.path.join(name, INCOMPLETE))]


def _column_bytes(name):
    """Return the size of the column to be added: complex64, all rows, channels and correlations."""
    with opened("table", name) as tb:
        if _COLUMN in tb.colnames():
            return 0
        rows = np.bincount(tb.getcol("DATA_DESC_ID"))
    with opened("msmetadata", name) as md:
        cells = [
            md.nchan(md.spwfordatadesc(dd)) * len(md.corrtypesforpol(md.polidfordatadesc(dd)))
            for dd in range(rows.size)
        ]
    return 8 * int(rows @ np.array(cells))


def write_model_column(selection, phase_center, predict):
    """Fill MODEL_DATA of the selected rows and channels, flagged ones too.

    The model visibility is the same for both parallel hands (unpolarised) and 0 for cross-hands.
    Any model kept in the header (usescratch=False) is deleted, so that it does not go first.
    A column that is there keeps what it holds outside the selection; a new one holds
    CASA's default of 1 there. SIGINT and SIGTERM wait until the column is whole and has been read back.

    Parameters
    ----------
    selection : casa_sara.options.Selection
    phase_center : dict
        Direction of the image centre, `Visibilities.phase_center`.
    predict : callable
        Takes uvw float64 (3, M) in wavelengths and returns the complex (M,) visibilities in Jy
        of the model image, at the image's phase centre.

    Raises
    ------
    OSError
        The disk has no room for the column; the MeasurementSet is as it was.
    RuntimeError
        When what is read back is not what was written.
    """
    for ms in select_data(selection)[0]:
        with signals_deferred():
            _mark(ms.name)
            _make_column(ms.name)
            written = _write(ms, Geometry(ms, phase_center), predict)
            if written != [_checksum(values) for values in _read_back(ms)]:
                raise RuntimeError(f"{_COLUMN} of '{ms.name}' does not read back as it was written: do not use it")
            os.unlink(os.path.join(ms.name, INCOMPLETE))


def _mark(name):
    """Say in the MeasurementSet that its model column is not to be used."""
    since = datetime.now(timezone.utc).isoformat(" ", "seconds")
    Path(name, INCOMPLETE).write_text(
        f"Process {os.getpid()} on {socket.gethostname()} began to write {_COLUMN} at {since}. Where it has ended, the column "
        "is incomplete: tsara with restart=True, niter=0, savemodel='modelcolumn' writes it anew.\n", encoding="utf-8")


def _make_column(name):
    """Delete a model in the header; add the column where it is missing.

    That takes disk space, so a child process does it, which may fail without harm: until the column stands whole, the
    description of the table is the old one, and new files beside it belong to nothing. Only where this
    process holds the MeasurementSet open elsewhere, a child would wait for it forever, and it is done here.
    """
    before, description = set(os.listdir(name)), Path(name, "table.dat").read_bytes()
    missing = _column_bytes(name)
    try:
        _check_space(name, missing)
        if _held_open(name):
            add_column(name)
        else:
            in_child("column", name=name)
    except (ChildError, OSError) as error:
        if missing and Path(name, "table.dat").read_bytes() == description:
            for file in set(os.listdir(name)) - before:
                os.unlink(os.path.join(name, file))
            os.unlink(os.path.join(name, INCOMPLETE))
        if isinstance(error, OSError):
            raise
        raise OSError(errno.ENOSPC if "No space" in str(error) else errno.EIO,
                      f"savemodel = 'modelcolumn': {_COLUMN} could not be added to '{name}': {error}") from error


def add_column(name):
    """Delete a model in the header; add the column where it is missing, filled with 1."""
    with opened("calibrater", name, addcorr=False, addmodel=True) as cb:
        cb.delmod(otf=True, scr=False)


def _held_open(name):
    """Return whether this process has files of a MeasurementSet open, as far as the system tells."""
    folder, files = os.path.realpath(name) + os.sep, "/proc/self/fd"
    if not os.path.isdir(files):
        return True
    return any(os.path.realpath(os.path.join(files, file)).startswith(folder) for file in os.listdir(files))


def _pieces(ms):
    """Yield (group, rows) of the pieces in which the column is written."""
    for group in ms.groups:
        count = max(1, _CHUNK // group.channels.size)
        for start in range(0, group.rows.size, count):
            yield group, group.rows[start : start + count]


def _corners(group):
    """Return the slice of the column's cells that holds the selected channels."""
    return [0, int(group.channels[0])], [len(group.correlations) - 1, int(group.channels[-1])], [1, 1]


def _write(ms, geometry, predict):
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
                model[usable] = _at_field_centre(predict, *geometry.wavelengths(group, field, time, uvw_m[:, usable]))
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
    """Return where the parallel hands stand among the correlations."""
    return [k for k, name in enumerate(group.correlations) if name in ("I", "RR", "LL", "XX", "YY")]


def _at_field_centre(predict, uvw, shift):
    """Predict, and turn the visibilities back from the image's phase centre to the field's."""
    model = np.asarray(predict(uvw.reshape(3, -1))).reshape(uvw.shape[1:])
    return model if shift is None else model * np.exp(2j * np.pi * shift)


def _read_back(ms):
    """Yield the pieces as they stand on disk."""
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
