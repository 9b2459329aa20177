"""The model image's visibilities into MODEL_DATA, for self-calibration.

This is the only place where a user's MeasurementSet is changed, so it comes last in a run
and is checked before: `check_model_column_writable` can be called before hours are spent.
"""

from __future__ import annotations

import os
import shutil
import signal
import threading
import zlib
from contextlib import contextmanager

import numpy as np

from casa_sara.casa.frames import Geometry
from casa_sara.casa.selection import select_data
from casa_sara.casa.tools import opened

__all__ = ["check_model_column_writable", "write_model_column"]

_COLUMN = "MODEL_DATA"
_CHUNK = 1_000_000  # visibilities predicted at a time
_SPARE = 1.05  # of the disk space computed


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
        free = shutil.disk_usage(name).free
        if count * _SPARE > free:
            raise OSError(
                f"savemodel = 'modelcolumn' needs {count * _SPARE / 1e9:.2f} GB for {_COLUMN}, but the disk of "
                f"'{name}' has {free / 1e9:.2f} GB left: free some, or set savemodel = 'none'"
            )


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
    RuntimeError
        When what is read back is not what was written.
    """
    for ms in select_data(selection)[0]:
        with _signals_deferred():
            _make_column(ms.name)
            written = _write(ms, Geometry(ms, phase_center), predict)
            if written != [_checksum(values) for values in _read_back(ms)]:
                raise RuntimeError(f"{_COLUMN} of '{ms.name}' does not read back as it was written: do not use it")


def _make_column(name):
    """Delete a model in the header; add the column where it is missing."""
    with opened("calibrater", name, addcorr=False, addmodel=True) as cb:
        cb.delmod(otf=True, scr=False)


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


@contextmanager
def _signals_deferred():
    """Hold back SIGINT and SIGTERM, and deliver them at the end. Only the main thread can."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    received = []
    deferred = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.signal(number, lambda *got: received.append(got[0])) for number in deferred}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for number in received:
            signal.raise_signal(number)
