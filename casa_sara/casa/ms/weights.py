"""Density of the sampling and imaging weights, as casatools imager and tclean define them.

Both count the summed natural weight of the samples in each cell of the uv plane, of side
1/(n·cell) for an image of n pixels; a sample counts at (u, v) and at (−u, −v). The index of
a cell is trunc(n·cell·u + n//2) in single precision, where u is in metres times the rounded
wave number; index 0 and what lies beyond the grid are left out. tclean takes −u for u, LSRK
frequencies and the image's size in each axis, and for the channels of a cube it rounds where it
truncates otherwise; imager takes the frequencies of the data and one size for both axes. Neither turns the
baselines to the phase centre of the image before it counts. Both also count what they do not
image, autocorrelations and rows flagged by FLAG_ROW alone; here these are left out.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from casa_sara.casa.ms.frames import SPEED_OF_LIGHT
from casa_sara.casa.ms.msselect import for_parser
from casa_sara.casa.ms.subtables import readable
from casa_sara.casa.ms.usable_samples import IN_FLAGS
from casa_sara.casa.runtime.quantities import radians
from casa_sara.casa.runtime.tools import opened
from casa_sara.options import ImageGrid, Weighting
from casa_sara.parallel.serial import SERIAL

__all__ = ["dirty_image", "imaging_weights", "sampling_density", "sum_of_weights"]

WEIGHTINGS = ("natural", "uniform", "briggs")
MOST_CELLS = 16384  # of the uv grid, along each axis, that npixels may ask for
_SELECTVIS_KEYS = {"timerange": "time", "antenna": "baseline"}
_WAVELENGTHS = re.compile(r"\s*(\d+\.?\d*|\.\d+)(e[-+]?\d+)?\s*(k|M|)(lambda)?\s*", re.IGNORECASE)


def sampling_density(visibilities, selection, grid, comm=SERIAL):
    """Density of the sampling at every sample, from casatools imager's uniform weighting.

    The uv cells are square, of side 1/(field of view) of the larger image side. imager reads
    the selection again, without autocorrelations and flagged rows; the MeasurementSets are
    opened read-only and nothing is written to them. Where samples were left out that no flag
    told it of, where one correlation has no weight, where only some rows of a MeasurementSet have a WEIGHT_SPECTRUM,
    and where its grid cannot be right, because it holds less than the sample itself, the samples are counted here.

    Parameters
    ----------
    visibilities : casa_sara.data.visibilities.Visibilities
        The samples.
    selection : casa_sara.options.Selection or None
        That is read again; None where the samples are not all of a selection, but those of one channel of a cube, and
        so are counted here.
    grid : casa_sara.options.ImageGrid
        Size, pixels, direction and gridder of the image.
    comm : casa_sara.parallel.serial.Serial or MPI
        Over whose ranks the samples are spread; rank 0 asks imager.

    Returns
    -------
    density : float32 (M,)
        Summed natural weight, in 1/Jy², of the samples in the uv cell of each sample;
        positive and finite.
    """
    cell = float(min(grid.cell_rad))
    side = math.ceil(max(n * c for n, c in zip(grid.shape, grid.cell_rad)) / cell - 1e-6)
    if visibilities.scratch.on_disk:
        return _counted_density(visibilities, side, cell)
    u, v = _field_uv(visibilities, _window_wave_numbers(visibilities))
    cells = _cells(u, v, (side, side), (cell, cell))
    density = np.zeros(visibilities.size, np.float32)
    in_flags = visibilities.dropped.keys() <= set(IN_FLAGS)
    if selection is not None and in_flags and not visibilities.alone and not visibilities.mixed_weights:
        for number in np.unique(np.concatenate(comm.allgather(np.unique(visibilities.rows.ms)))):
            try:
                density += comm.once(_imager_grid, visibilities.ms_names[number], selection.of(number), side,
                                     cell)[cells]
            except RuntimeError as error:
                raise ValueError(f"vis = '{visibilities.ms_names[number]}': CASA finds no density of the samples, on "
                                 f"{side} x {side} cells for imsize = {list(grid.shape)}: "
                                 f"{' '.join(str(error).split())}") from error
    weight = visibilities.imaging_weight
    bad = ~((density >= 0.5 * weight) & np.isfinite(density))
    if comm.total(np.count_nonzero(bad)):
        opposite = _cells(-u, -v, (side, side), (cell, cell))
        density[bad] = comm.allreduce(_count(cells, opposite, weight, side * side))[cells[bad]]
    return np.maximum(density, weight)


def _counted_density(visibilities, side, cell):
    """Return the same, counted here, of samples on the disk."""
    counts, of_windows, uvw_m = np.zeros(side * side), _window_wave_numbers(visibilities), _row_uvw(visibilities)

    def cells_of(part, *signs):
        u, v = _field_uv(part, of_windows, uvw_m)
        return [_cells(sign * u, sign * v, (side, side), (cell, cell)) for sign in signs]

    for _, part in visibilities.parts():
        counts += _count(*cells_of(part, 1, -1), part.imaging_weight, side * side)
    density = visibilities.scratch.empty(visibilities.size, np.float32)
    for piece, part in visibilities.parts():
        density[piece] = np.maximum(counts[cells_of(part, 1)[0]], part.imaging_weight)
    return density


def imaging_weights(visibilities, grid, weighting, comm=SERIAL):
    """tclean's imaging weights of every sample, which make the PSF and the residual image.

    With w the natural weight and G the summed natural weight in the sample's uv cell:

    natural  w
    uniform  w / G
    briggs   w / (G·f² + 1),  f² = (5·10^−robust)² / (ΣG²/ΣG)

    times the Gaussian taper. With `mosweight`, G is that of each field of a mosaic. `npixels` sets the uv cell of
    uniform and briggs to 1/(npixels·cell). Samples beyond the grid have no weight.

    Parameters
    ----------
    visibilities : casa_sara.data.visibilities.Visibilities
        The samples.
    grid : casa_sara.options.ImageGrid
        Size, pixels, direction and gridder of the image.
    weighting : casa_sara.options.Weighting
        Imaging weights that were asked for.
    comm : casa_sara.parallel.serial.Serial or MPI
        Over whose ranks the samples are spread.

    Returns
    -------
    weights : float32 (M,)
    """
    if weighting.weighting not in WEIGHTINGS:
        raise ValueError(f"weighting = '{weighting.weighting}' is not one of {', '.join(WEIGHTINGS)}")
    if grid.is_mosaic and weighting.mosweight and weighting.weighting != "natural":
        return _weights_by_field(visibilities, grid, replace(weighting, mosweight=False), comm)
    taper = _taper_parameters(weighting.uvtaper)
    weights, counts = visibilities.scratch.empty(visibilities.size, np.float32), None
    uvw_m = None if weighting.weighting == "natural" and taper is None else _row_uvw(visibilities)
    if weighting.weighting != "natural":
        counts = _Counts.of(visibilities, uvw_m, grid, weighting, comm)
    for piece, part in visibilities.parts():
        of_part = part.imaging_weight.copy()
        if uvw_m is not None:
            u, v = _field_uv(part, uvw_m=uvw_m)
        if counts is not None:
            density = counts.density(u, v)
            of_part = np.divide(of_part, density, out=np.zeros_like(of_part), where=density > 0, casting="same_kind")
        if taper is not None:
            of_part *= _taper(u, v, *taper)
        weights[piece] = of_part
    return weights


@dataclass
class _Counts:
    """The summed natural weights of the samples in the cells of a uv grid."""

    shape: tuple[int, int]
    grid: ImageGrid
    weighting: Weighting
    counts: np.ndarray

    @classmethod
    def of(cls, visibilities, uvw_m, grid, weighting, comm):
        """Count."""
        _check_npixels(weighting)
        shape = (weighting.npixels, weighting.npixels) if weighting.npixels else grid.shape
        counts = cls(shape, grid, weighting, np.zeros(shape[0] * shape[1]))
        for _, part in visibilities.parts():
            u, v = _field_uv(part, uvw_m=uvw_m)
            counts.counts += _count(counts.cells(-u, v), counts.cells(u, -v), part.imaging_weight, counts.counts.size)
        comm.allreduce(counts.counts)
        if not counts.counts.any():
            raise ValueError(f"npixels = {weighting.npixels} leaves no sample in the uv grid: take 0 or more")
        return counts

    def cells(self, u, v):
        """Return the cell of each sample."""
        return _cells(u, v, self.shape, self.grid.cell_rad, np.rint if self.grid.is_cube else np.trunc)

    def density(self, u, v):
        """Return by what uniform and briggs divide the natural weights, real (M,): 0 beyond the grid."""
        density = self.counts[self.cells(-u, v)]
        if self.weighting.weighting == "uniform":
            return density
        scale = (5.0 * 10.0**-self.weighting.robust) ** 2 * self.counts.sum() / np.square(self.counts).sum()
        return np.where(density > 0, density * scale + 1.0, 0.0)


def _check_npixels(weighting):
    """Raise where there would be too many cells."""
    if weighting.npixels > MOST_CELLS:
        raise ValueError(f"npixels = {weighting.npixels}: should be at most {MOST_CELLS}")


def _weights_by_field(visibilities, grid, weighting, comm):
    """Return the imaging weights of every field by itself, float32 (M,)."""
    rows, weights = visibilities.rows, np.empty(visibilities.size, np.float32)
    fields = int(comm.largest(int(rows.field.max(initial=0)))) + 1
    field = (rows.ms.astype(np.int64) * fields + rows.field)[visibilities.row]
    for number in np.unique(np.concatenate(comm.allgather(np.unique(field)))):
        here = np.flatnonzero(field == number)
        weights[here] = imaging_weights(visibilities.part(here), grid, weighting, comm)
    return weights


def sum_of_weights(visibilities, weights, stokes="I"):
    """tclean's `.sumwt`: each sample of Stokes I alone counts once for each parallel-hand correlation in its mean."""
    if stokes != "I":
        return float(weights.sum(dtype=float))
    return sum(float(np.dot(weights[piece], part.rows.hands[part.row].astype(float)))
               for piece, part in visibilities.parts())


def dirty_image(operator, vis, weights, comm=SERIAL):
    """Re Σ_m w_m V_m exp(−2πi(u_m·l + v_m·m)) / Σ w, in Jy/beam.

    With vis = 1 this is the PSF, whose centre is 1.

    Parameters
    ----------
    operator : MeasurementOperator, without whitening
        The measurement operator without weights.
    vis : complex (M,), 1 or callable
        Jy; or, of an operator in pieces, what returns them from a slice and its operator.
    weights : real (M,)
        Imaging weights.
    comm : casa_sara.parallel.serial.Serial or MPI
        Over whose ranks the samples are spread; the operator sums over them.

    Returns
    -------
    image : real (nx, ny)
    """
    total = comm.total(float(weights.sum(dtype=np.float64)))
    if not total > 0:
        raise ValueError("the imaging weights of all samples are zero: weighting, npixels or uvtaper leave nothing")
    weighted = partial(_weighted, weights, vis) if callable(vis) else weights * vis
    return operator.adjoint(weighted) / operator.dtype.type(total)


def _weighted(weights, vis, piece, operator):
    """Return the weighted visibilities of a slice."""
    return weights[piece] * vis(piece, operator)


def _imager_grid(name, strings, side, cell):
    """Return imager's density grid of one MeasurementSet, flat (side·side,)."""
    import casatools

    im = casatools.imager()
    try:
        chosen = {_SELECTVIS_KEYS.get(parameter, parameter): value
                  for parameter, value in for_parser(name, strings).items()}
        im.selectvis(vis=readable(name), writeaccess=False, taql="ANTENNA1 != ANTENNA2 && !FLAG_ROW", **chosen)
        im.defineimage(nx=side, ny=side, cellx=f"{cell!r}rad", celly=f"{cell!r}rad", mode="mfs", stokes="I")
        im.weight(type="uniform", npixels=side)
        return im.getweightgrid(type="imaging").reshape(-1, order="F")
    finally:
        im.done()


def _row_uvw(visibilities):
    """Return the baselines in metres of every row, float64 (3, R)."""
    rows = visibilities.rows
    uvw_m = np.empty((3, rows.row.size))
    for number in np.unique(rows.ms):
        here = rows.ms == number
        with opened("table", visibilities.ms_names[number]) as tb:
            uvw_m[:, here] = tb.getcol("UVW")[:, rows.row[here]]
    return uvw_m


def _field_uv(visibilities, of_windows=None, uvw_m=None):
    """Return float32 u, v (M,) in wavelengths at the centre of the field that was observed.

    `of_windows` are the wave numbers of the channels as they stand in the MeasurementSets; without them they are those
    of LSRK frequencies. `uvw_m` are the baselines of the rows, where they have been read.
    """
    uvw_m = _row_uvw(visibilities) if uvw_m is None else uvw_m
    if of_windows is not None:
        wave_numbers = _channel_wave_numbers(visibilities, of_windows)
    else:  # a baseline keeps its length when it is turned to another phase centre
        lengths = np.sqrt(np.square(uvw_m).sum(axis=0))
        wave_numbers = np.sqrt(np.einsum("xm,xm->m", visibilities.uvw, visibilities.uvw))
        wave_numbers /= np.maximum(lengths, np.finfo(float).tiny)[visibilities.row]
    wave_numbers = wave_numbers.astype(np.float32)
    return tuple((uvw_m[axis, visibilities.row] * wave_numbers).astype(np.float32) for axis in (0, 1))


def _channel_wave_numbers(visibilities, of_windows):
    """Return wavelengths per metre (M,) at the channel frequencies as they are in the data."""
    rows, wave_numbers = visibilities.rows, np.empty(visibilities.size)
    for (ms, spw), of_channels in of_windows.items():
        here = ((rows.ms == ms) & (rows.spw == spw))[visibilities.row]
        wave_numbers[here] = of_channels[visibilities.chan[here]]
    return wave_numbers


def _window_wave_numbers(visibilities):
    """Return (MeasurementSet, spw) → wavelengths per metre of its channels, as their frequencies are in the data."""
    of_windows = {}
    for ms, spws in visibilities.spws.items():
        with opened("msmetadata", readable(visibilities.ms_names[ms])) as md:
            of_windows |= {(ms, spw): md.chanfreqs(spw) / SPEED_OF_LIGHT for spw in spws}
    return of_windows


def _cells(u, v, shape, cell_rad, to_cell=np.trunc):
    """Return the index of the uv cell of each sample in the flat grid, i + nx·j, 0 where it has none."""
    i, j = (to_cell(np.float32(n * cell) * x + np.float32(n // 2)) for n, cell, x in zip(shape, cell_rad, (u, v)))
    inside = (i > 0) & (i < shape[0]) & (j > 0) & (j < shape[1])
    i, j = (np.where(inside, index, 0).astype(np.intp) for index in (i, j))
    return i + shape[0] * j


def _count(cells, opposite, weight, size):
    """Return the summed weight in each cell, of the samples and of their conjugates."""
    counts = np.bincount(cells, weight, size)
    counts += np.bincount(opposite, weight, size)
    counts[0] = 0
    return counts


def _taper_parameters(uvtaper):
    """Return (HWHM along the position angle, HWHM across it) in wavelengths and the angle in radians."""
    values = (uvtaper,) if isinstance(uvtaper, str) else tuple(str(value) for value in uvtaper)
    values = tuple(value for value in values if value.strip())
    if not values:
        return None
    if len(values) > 3:
        raise ValueError(f"uvtaper = {list(values)} has {len(values)} entries: it takes [major, minor, position angle]")
    widths = [_half_width(value) for value in values[:2]]
    angle = radians(values[2], "uvtaper") if len(values) == 3 else 0.0
    return widths[0], widths[-1], angle


def _half_width(value):
    """Return the HWHM in wavelengths of 'number', 'number[k|M]lambda' or of an angle, the FWHM on the sky."""
    match = _WAVELENGTHS.fullmatch(value)
    if match and (match[4] or not match[3]):
        width = float(match[1] + (match[2] or "")) * {"": 1.0, "k": 1e3, "m": 1e6}[match[3].lower()]
    else:
        fwhm = radians(value, "uvtaper")
        width = 2.0 * math.log(2.0) / (math.pi * fwhm) if fwhm > 0 else 0.0
    if not width > 0:
        raise ValueError(f"uvtaper = '{value}' is not a positive width")
    return width


def _taper(u, v, along, across, angle):
    """Return the Gaussian of these half widths; the angle runs from v (north) to u (east)."""
    sin, cos = np.float32(math.sin(angle)), np.float32(math.cos(angle))
    with np.errstate(over="ignore", under="ignore"):  # 0 where it is that narrow
        square = ((u * sin + v * cos) / np.float32(along)) ** 2 + ((v * sin - u * cos) / np.float32(across)) ** 2
        return np.exp2(-square)
