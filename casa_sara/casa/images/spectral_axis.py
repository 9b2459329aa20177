"""The spectral axis of a cube, which is tclean's, and the channel of the image that each sample belongs to.

CASA's synthesisimager lays the axis out, so it is tclean's by construction. Each sample goes whole to the channel whose
range holds its frequency in the frame of the axis: tclean's interpolation = 'nearest'. As there, the frequency of a
sample is followed in time to LSRK, and goes from LSRK to the frame of the axis at the date of the image.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from casa_sara.casa.images.image_plane import define_image_plane
from casa_sara.casa.ms.frames import Geometry, image_direction
from casa_sara.casa.ms.selection import select_data
from casa_sara.casa.ms.subtables import readable
from casa_sara.casa.runtime.quantities import check_frequency, check_spectral
from casa_sara.casa.runtime.tools import opened

__all__ = ["SpectralAxis", "channel_number", "channels_of", "samples_of_channels", "spectral_axis"]

_SHAPE = (16, 16)  # pixels of an image that is made for its axis only


@dataclass(frozen=True)
class SpectralAxis:
    """The channels of a cube.

    Attributes
    ----------
    freqs_hz : float64 (nchan,)
        Centres, in the frame of the axis.
    lsrk_hz : float64 (nchan + 2,)
        Centres in LSRK, with those of one more channel before and after.
    frame : str
        As 'LSRK'.
    """

    freqs_hz: np.ndarray
    lsrk_hz: np.ndarray
    frame: str

    @classmethod
    def of(cls, plane):
        """Read it out of the coordinates of a cube (ImagePlane)."""
        import casatools

        csys = casatools.coordsys()
        csys.fromrecord(plane.csys)
        csys.setunits(["Hz"], type="spectral")
        frame = csys.referencecode("spectral")[0]
        freqs = _frequencies(csys, plane.channels)
        csys.setconversiontype(spectral="LSRK")
        lsrk = _frequencies(csys, plane.channels)
        ends = 2 * lsrk[[0, -1]] - lsrk[[1, -2]] if lsrk.size > 1 else lsrk[0] + np.array([-1, 1]) * _step(csys)
        return cls(freqs, np.concatenate([ends[:1], lsrk, ends[1:]]), frame)

    @property
    def size(self) -> int:
        """Number of channels."""
        return self.freqs_hz.size

    def nearest(self, lsrk_hz):
        """Return the channel, int (M,), that holds each LSRK frequency, −1 where none does."""
        sign = np.sign(self.lsrk_hz[-1] - self.lsrk_hz[0])
        pixel = np.interp(sign * lsrk_hz, sign * self.lsrk_hz, np.arange(-1, self.size + 1))
        channel = np.floor(pixel + 0.5).astype(np.int32)
        return np.where(channel < self.size, channel, -1)


def _frequencies(csys, nchan):
    """Return the frequencies of all channels in Hz, as the coordinates give them now."""
    pixels = np.repeat(csys.referencepixel()["numeric"][:, None], nchan, axis=1)
    axis = int(csys.findcoordinate("spectral")["pixel"][0])
    pixels[axis] = np.arange(nchan)
    return csys.toworldmany(pixels)["numeric"][axis]


def _step(csys):
    """Return the increment of the frequency, Hz."""
    return float(csys.increment(type="spectral")["numeric"][0])


def channel_number(value, parameter):
    """Return `start` or `width` as CASA takes it: '', a channel number, or a frequency or velocity with its unit.

    Raises
    ------
    ValueError
        It is something else.
    """
    if isinstance(value, int) or value == "":
        return value
    try:
        return int(value)  # which tclean passes over, when it is text
    except ValueError:
        check_spectral(value, parameter)
        return value


def check_axis(grid):
    """Raise ValueError for parameters of a spectral axis that do not go together."""
    for text in grid.restfreq:
        check_frequency(text, "restfreq")
    if grid.nchan == 0 or grid.nchan < -1:
        raise ValueError(f"nchan = {grid.nchan}: should be the number of channels, or -1 for all that the data have")
    if isinstance(grid.start, int) and grid.start < 0:
        raise ValueError(f"start = {grid.start}: channels of the data begin with 0")
    if grid.width == 0:
        raise ValueError(f"width = {grid.width}: should be how many data channels make one, negative for falling order")
    kinds = [type(value) if isinstance(value, int) else check_spectral(value, name)
             for name, value in (("start", grid.start), ("width", grid.width)) if value != ""]
    if len(set(kinds)) > 1:
        raise ValueError(f"start = {grid.start!r} and width = {grid.width!r}: should both be channels, both "
                         "frequencies, or both velocities")


@dataclass(frozen=True)
class _Origin:
    """Of visibilities that are not read yet, what an image plane takes its coordinates from."""

    ms_names: tuple
    spws: dict
    phase_center: dict


def spectral_axis(selection, grid):
    """Return the axis of the cube of a selection; only the descriptions of the data are read.

    Raises
    ------
    ValueError
        CASA cannot make an axis of the task parameters nchan, start, width, outframe, veltype and restfreq.
    """
    check_axis(grid)
    selected = select_data(selection)[0]
    last = max(int(group.channels.max()) for ms in selected for group in ms.groups)
    if isinstance(grid.start, int) and grid.start > last:
        raise ValueError(f"start = {grid.start}: the last channel that is selected is {last}")
    spws = {ms.number: () for ms in selected}
    origin = _Origin(tuple(selection.vis), spws, image_direction(grid.phasecenter, selected))
    return SpectralAxis.of(define_image_plane(origin, selection, replace(grid, shape=_SHAPE)))


def samples_of_channels(selection, axis):
    """Return about how many samples each channel will have, int (nchan,): with flagged ones, and a resting Earth."""
    count = np.zeros(axis.size + 1, int)  # the last one is for what falls into none
    for ms in select_data(selection)[0]:
        geometry = Geometry(ms, next(iter(ms.fields.values())))
        for group in ms.groups:
            factor = geometry.lsrk_factors(group.frame, np.array([min(ms.fields)]), np.array([ms.start_s]))
            np.add.at(count, axis.nearest(group.freqs_hz * factor), group.rows.size)
    return count[:-1]


def channels_of(visibilities, selection, axis):
    """Return the channel of the cube, int32 (M,), that each sample belongs to; −1 where it is none.

    Parameters
    ----------
    visibilities : casa_sara.data.visibilities.Visibilities
        The samples.
    selection : casa_sara.options.Selection
        That gave them.
    axis : SpectralAxis
        The channels of the cube.
    """
    rows = visibilities.rows
    channel = np.full(visibilities.size, -1, np.int32)
    factors = np.ones(rows.row.size)
    for ms in select_data(selection)[0]:
        geometry = Geometry(ms, visibilities.phase_center)
        with opened("msmetadata", readable(ms.name)) as md:
            for spw, frame in {(group.spw, group.frame) for group in ms.groups}:
                here = (rows.ms == ms.number) & (rows.spw == spw)
                factors[here] = geometry.lsrk_factors(frame, rows.field[here], rows.time[here])
                samples = np.flatnonzero(here[visibilities.row])
                lsrk = md.chanfreqs(spw)[visibilities.chan[samples]] * factors[visibilities.row[samples]]
                channel[samples] = axis.nearest(lsrk)
    return channel
