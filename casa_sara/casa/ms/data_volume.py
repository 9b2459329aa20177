"""The number of visibilities of a selection and their range in uvw, counted before they are read."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from casa_sara.casa.ms.frames import SPEED_OF_LIGHT
from casa_sara.casa.ms.selection import select_data
from casa_sara.casa.ms.table_cells import read_slice
from casa_sara.casa.ms.usable_samples import LONGEST_M
from casa_sara.casa.runtime.tools import opened

__all__ = ["DataVolume", "measure_volume"]

_CHUNK = 4_000_000  # flags read at a time
_DOPPLER = 1 + 2e-4  # of the Earth's motion, and of the difference between phase centres


@dataclass(frozen=True)
class DataVolume:
    """What will be read, at most.

    Attributes
    ----------
    samples : int
        Visibilities of Stokes I.
    reach : (float, float)
        Largest |u| and |v| in wavelengths.
    max_w : float
        Largest |w| in wavelengths.
    freq_range_hz : (float, float)
        Lowest and highest frequency of a channel's middle.
    """

    samples: int
    reach: tuple[float, float]
    max_w: float = 0.0
    freq_range_hz: tuple[float, float] = (0.0, 0.0)


def measure_volume(selection, flags=False, stokes="I"):
    """Count the samples of a selection without its autocorrelations, in the time that the rows' uvw take to read.

    Parameters
    ----------
    selection : casa_sara.options.Selection
        The MeasurementSets and the data selected in them.
    flags : bool
        Read the flags too, so that the count is exact but for data and weights that are not finite.
    stokes : str
        Stokes parameter of the image.

    Returns
    -------
    DataVolume
    """
    samples, reach, freqs_hz = 0, np.zeros(3), []
    for ms in select_data(selection, stokes)[0]:
        with opened("table", ms.name) as tb:
            cross = tb.getcol("ANTENNA1") != tb.getcol("ANTENNA2")
            metres = np.abs(tb.getcol("UVW"))
            metres[~(metres <= LONGEST_M)] = 0  # neither NaN nor what no baseline has
            for group in ms.groups:
                rows = group.rows[cross[group.rows]]
                samples += _unflagged(tb, rows, group) if flags else rows.size * group.channels.size
                longest = metres[:, rows].max(axis=1, initial=0.0)
                reach = np.maximum(reach, longest * group.freqs_hz.max() * _DOPPLER / SPEED_OF_LIGHT)
                freqs_hz += [float(group.freqs_hz.min()), float(group.freqs_hz.max())]
    u, v, w = reach.tolist()
    return DataVolume(int(samples), (u, v), w, (min(freqs_hz, default=0.0), max(freqs_hz, default=0.0)))


def _unflagged(tb, rows, group):
    """Count the samples of which no correlation is flagged."""
    first, count = group.channels[0], 0
    low, high = [0, int(first)], [len(group.correlations) - 1, int(group.channels[-1])]
    step = max(1, _CHUNK // (int(np.ptp(group.channels) + 1) * len(group.correlations)))
    for start in range(0, rows.size, step):
        some = rows[start : start + step]
        part = tb.selectrows(some.tolist())
        try:
            flag = np.any(read_slice(part, "FLAG", group.has("FLAG", some), low, high, bool),
                          axis=0)[group.channels - first]
            count += np.count_nonzero(~(flag | part.getcol("FLAG_ROW")))
        finally:
            part.close()
    return count
