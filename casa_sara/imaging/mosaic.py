"""What a mosaic needs between reading and solving: the primary beams of its samples, and images of flat noise."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from casa_sara.casa.images.primary_beams import Profiles, primary_beams
from casa_sara.casa.ms.frames import SPEED_OF_LIGHT, separation
from casa_sara.casa.runtime import log
from casa_sara.data.visibilities import Visibilities
from casa_sara.operators.beams import Beam, Mosaic
from casa_sara.operators.mosaic import remaining_w_phase
from casa_sara.operators.sky import sky_operator
from casa_sara.parallel.serial import SERIAL

__all__ = ["MosaicModel", "beams_record", "check_pointings", "flat_noise", "predicted", "w_note", "weight_image",
           "with_beams"]

SAME_POINTING = 1e-6  # rad, the least that fields may be apart
SAME_BEAM = 0.01  # of the beam of a dish of 25 m, the largest that is common
LARGEST_DISH_M = 25.0
ARCSEC_PER_RAD = 180 * 3600 / np.pi


def check_pointings(data, grid):
    """Return the notes about fields in different directions that are imaged as one pointing.

    Parameters
    ----------
    data : casa_sara.data.visibilities.Visibilities
        With `fields`.
    grid : casa_sara.options.ImageGrid
        Its `gridder` and `onepointing` decide.

    Returns
    -------
    list of str

    Raises
    ------
    ValueError
        They would be imaged as one pointing, and onepointing = True has not been said.
    """
    directions = list(data.fields.values())
    if grid.is_mosaic or not directions:
        return []
    spread = max(separation(direction, directions[0]) for direction in directions)
    wavelength = SPEED_OF_LIGHT / max(data.freq_range_hz[1], 1.0)
    if spread <= max(SAME_POINTING, SAME_BEAM * wavelength / LARGEST_DISH_M):
        return []
    apart = f"{len(directions)} fields, up to {spread * ARCSEC_PER_RAD:.1f} arcsec apart"
    if not grid.onepointing:
        raise ValueError(f"gridder = '{grid.gridder}': {apart}, would be imaged as one pointing: should be gridder = "
                         "'mosaic', which models their primary beams, or one field, chosen with field. onepointing = "
                         "True images them as one pointing nevertheless")
    return [f"{apart}, are imaged as one pointing: their different primary beams are not modelled"]


def with_beams(data, selection, grid, comm=SERIAL):
    """Find the primary beams of the samples, and leave out the samples that see nothing of the image.

    Parameters
    ----------
    data : casa_sara.data.visibilities.Visibilities
        With `freq_hz` and `fields`.
    selection : casa_sara.options.Selection
        Of the data.
    grid : casa_sara.options.ImageGrid
        Size, pixels and direction of the image.
    comm : casa_sara.parallel.serial.Serial or MPI
        Over whose ranks the samples are spread.

    Returns
    -------
    data : Visibilities
        With `beam`.
    grid : ImageGrid
        With `mosaic`.

    Raises
    ------
    ValueError
        The beams are not known, or no pointing sees the centre of the image.
    """
    found = primary_beams(data, selection, grid, comm=comm)
    log.info(found.words)
    mosaic, beam = _mosaic(found, grid)
    data = replace(data, beam=beam)
    kept = np.flatnonzero(beam >= 0)
    if beyond := comm.total(data.size - kept.size):
        note = f"{beyond} visibilities are of pointings that see nothing of the image, and are left out"
        data = replace(data.part(kept), dropped=data.dropped | {"beyond the image": beyond}, notes=[*data.notes, note])
    sums = comm.allreduce(mosaic.sums(data.beam, data.weight))
    seen = mosaic.sensitivity(sums) if sums.any() else np.zeros(grid.shape)
    if not seen[grid.shape[0] // 2, grid.shape[1] // 2] > 0:
        raise ValueError(f"phasecenter = '{grid.phasecenter}': no pointing sees the centre of the image: should be a "
                         "direction within the mosaic")
    return data, replace(grid, mosaic=replace(mosaic, profiles=found.profiles))


def _mosaic(found, grid):
    """Return the `Mosaic` of the beams that are in the image, and that of each sample or -1, int32 (M,)."""
    profiles = found.profiles
    centres = [tuple(centre) for centre in found.centres.tolist()]
    beams = [Beam(centres[p], float(profiles.radii[k]), profiles.values[k]) for p, k in found.beams]
    inside = np.array([all(part.stop > part.start for part in one.box(grid.shape, grid.cell_rad)) for one in beams])
    number = np.where(inside, np.cumsum(inside) - 1, -1).astype(np.int32)
    mosaic = Mosaic(grid.shape, grid.cell_rad, tuple(one for one, seen in zip(beams, inside) if seen))
    return mosaic, number[found.beam_of_sample]


def beams_record(data, grid):
    """Return, as plain values and arrays, what :class:`MosaicModel` takes for the beams of these data.

    Parameters
    ----------
    data : casa_sara.data.visibilities.Visibilities
        With `fields`.
    grid : casa_sara.options.ImageGrid
        With its mosaic.

    Returns
    -------
    dict
    """
    fields = [[*key, direction] for key, direction in data.fields.items()]
    return dict(fields=fields, **vars(grid.mosaic.profiles))


class MosaicModel:
    """Predicts the visibilities of a sky for rows of MeasurementSets, used or not.

    Parameters
    ----------
    model : real (nx, ny)
        Jy/pixel.
    grid : casa_sara.options.ImageGrid
        Its `spectrum` is used.
    selection : casa_sara.options.Selection
    phase_center : dict
        Direction of the image centre.
    beams : dict
        Of :func:`beams_record`, as it comes out of JSON.
    accuracy : dict
        `eps` and `nthreads` of the operator.
    axis : casa_sara.casa.images.spectral_axis.SpectralAxis, optional
        Of a cube, whose `model` is (nchan, nx, ny).
    """

    def __init__(self, model, grid, selection, phase_center, beams, accuracy, axis=None):
        self._model, self._grid, self._selection, self._accuracy = model, grid, selection, accuracy
        self._axis = axis
        fields = {(int(ms), int(field)): direction for ms, field, direction in beams["fields"]}
        self._profiles = Profiles(np.asarray(beams["bands_hz"]), [tuple(kind) for kind in beams["kinds"]],
                                  np.asarray(beams["radii"]), np.asarray(beams["values"]))
        self._where = dict(imaging_weight=None, chan=None, ms_names=selection.vis, phase_center=phase_center,
                           fields=fields)

    def __call__(self, uvw, freq_hz, rows):
        """Return the visibilities, complex (M,), at the phase centre of the image.

        Parameters
        ----------
        uvw : float64 (3, M)
            Wavelengths.
        freq_hz : float64 (M,)
            LSRK frequencies.
        rows : casa_sara.data.visibilities.RowTable
            Of R rows, of M/R channels each.
        """
        count = uvw.shape[1]
        vis = np.zeros(count, np.complex64)
        if not count:
            return vis
        row = np.repeat(np.arange(rows.ms.size), count // rows.ms.size)
        data = Visibilities(vis=vis, weight=np.ones(count), uvw=uvw, row=row, rows=rows, freq_hz=freq_hz, **self._where)
        of = partial(predicted, selection=self._selection, grid=self._grid, profiles=self._profiles, **self._accuracy)
        if self._axis is None:
            return of(self._model, data)
        channel = self._axis.nearest(freq_hz)
        for k in np.unique(channel[channel >= 0]):
            here = np.flatnonzero(channel == k)
            vis[here] = of(self._model[k], data.take(here))
        return vis


def predicted(model, data, selection, grid, profiles, **accuracy):
    """Return the visibilities of a sky through the primary beams of the samples, complex64 (M,).

    Parameters
    ----------
    model : real (nx, ny)
        Jy/pixel.
    data : casa_sara.data.visibilities.Visibilities
        The samples; those that see nothing of the image are 0.
    selection : casa_sara.options.Selection
        Of the data.
    grid : casa_sara.options.ImageGrid
        Of the model; its `spectrum` is used.
    profiles : casa_sara.casa.images.primary_beams.Profiles
        Of the beams of these data.
    **accuracy : object
        `eps` and `nthreads` of the operator.
    """
    vis = np.zeros(data.size, np.complex64)
    mosaic, beam = _mosaic(primary_beams(data, selection, grid, profiles), grid)
    seen = np.flatnonzero(beam >= 0)
    if seen.size:
        operator = sky_operator(data.uvw[:, seen], replace(grid, mosaic=mosaic), data.freq_hz[seen], beam=beam[seen],
                                **accuracy)
        vis[seen] = operator.forward(model)
    return vis


def w_note(max_w, mosaic, largest):
    """Return the warning about the w-term that a mosaic leaves out, where it is more than `largest` rad."""
    phase = remaining_w_phase(max_w, mosaic)
    if phase <= largest:
        return []
    return ["the w-term is modelled to first order around each pointing: what is left out changes phases by up to "
            f"{phase:.2g} rad at the edges of the primary beams; gridder = 'wproject' models it, for single pointings"]


def weight_image(data, grid, weights, comm=SERIAL):
    """Return Σ_g W_g A_g²/Σw, the weight of the data at each place of the sky, as tclean's .weight of a mosaic.

    Parameters
    ----------
    data : casa_sara.data.visibilities.Visibilities
        With `beam`.
    grid : casa_sara.options.ImageGrid
        With its mosaic.
    weights : real (M,)
        w; W_g is their sum over the samples of beam g.
    comm : casa_sara.parallel.serial.Serial or MPI
        Over whose ranks the samples are spread.

    Returns
    -------
    float32 (nx, ny)
    """
    sums = comm.allreduce(grid.mosaic.sums(data.beam, weights))
    return grid.mosaic.power(sums) / np.float32(comm.total(float(weights.sum(dtype=float))))


def flat_noise(dirty, weight):
    """Return Φ†(w V)/Σw of a mosaic as tclean's image of flat noise, sky × primary beam, real (nx, ny).

    Parameters
    ----------
    dirty : real (nx, ny)
        Σ_g A_g F†(w V)/Σw.
    weight : real (nx, ny)
        Σ_g W_g A_g²/Σw, tclean's .weight.

    Returns
    -------
    real (nx, ny)
        dirty/√(weight·largest weight), 0 where nothing is seen.
    """
    norm = np.sqrt(weight * weight.max())
    return np.divide(dirty, norm, out=np.zeros_like(dirty), where=norm > 0)
