"""The residuals of all cubes that are compared, channel by channel, by one operator and with the same weights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from casa_sara.casa.images.image_plane import define_image_plane
from casa_sara.casa.images.restore import fit_beam
from casa_sara.casa.images.sky_image import SkyPlane, beam_numbers
from casa_sara.casa.images.spectral_axis import channels_of
from casa_sara.casa.ms.read import read_visibilities
from casa_sara.casa.ms.weights import dirty_image, imaging_weights
from casa_sara.casa.runtime import log
from casa_sara.comparison.observed import common_gridder
from casa_sara.data.blocks import snapshot_blocks
from casa_sara.imaging.mosaic import check_pointings
from casa_sara.imaging.plane_images import IMAGE_EPS
from casa_sara.operators.sky import sky_operator
from casa_sara.options import ImageGrid, Weighting
from casa_sara.reconstruction.compile_cache import kernels_loading

__all__ = ["ObservedCube"]


class ObservedCube:
    """Visibilities by channel, and the residuals of models.

    Attributes
    ----------
    plane : SkyPlane
        The common grid.
    """

    def __init__(self, selection, first, request, sets, notes):
        plane = first.plane.upright()
        longitude, latitude = (float(angle) for angle in plane.centre)
        grid = ImageGrid(plane.shape, plane.cell_rad, f"{plane.frame} {longitude!r}rad {latitude!r}rad")
        with kernels_loading(log.info):
            data = read_visibilities(selection, grid.phasecenter)
        notes.extend(data.notes + check_pointings(data, replace(grid, onepointing=True)))
        gridder = common_gridder(sets, data.max_w, plane, notes)
        self._image_plane = define_image_plane(data, selection, grid)
        notes.extend(self._image_plane.notes)
        self.plane, self._data, self._nthreads = SkyPlane(self._image_plane.csys, plane.shape), data, request.nthreads
        self._grid = replace(grid, specmode="cube", gridder=gridder)
        self._weightings = {"natural": Weighting("natural"), "briggs": Weighting("briggs", request.robust)}
        channel = channels_of(data, selection, first.axis)
        self._order = np.argsort(channel, kind="stable")
        self._first = np.searchsorted(channel[self._order], np.arange(first.axis.size + 1))

    def measured(self, number, own, models):
        """Return beams, and by product residual images and χ² of the blocks, of one channel; nothing where it is blank.

        Parameters
        ----------
        number : int
            Of the channel.
        own, models : dict
            By name, the SkyImage of the channel, and its pixels on the common grid.

        Returns
        -------
        beams : dict
            Weighting → beam.
        residuals : dict
            Name → weighting → Jy/beam.
        chi_square : dict
            Name → χ² of each block.
        """
        data = self._data.part(self._order[self._first[number] : self._first[number + 1]])
        if not data.size:
            return {}, {name: {} for name in models}, {}
        operators = {}
        operator = self._operator(operators, self.plane, data)
        weights = {name: imaging_weights(data, self._grid, weighting) for name, weighting in self._weightings.items()}
        ones = np.ones(data.size, np.complex64)
        beams = {name: beam_numbers(fit_beam(dirty_image(operator, ones, one), self._image_plane))
                 for name, one in weights.items()}
        block_of_sample, blocks = snapshot_blocks(data)
        samples = np.array([block.samples for block in blocks])
        residuals, chi_square = {}, {}
        for name, image in own.items():
            plane, pixels = (image.plane, image.pixels) if image.plane.is_aligned(self.plane) else (self.plane,
                                                                                                models[name])
            left = data.vis - self._operator(operators, plane, data).forward(np.asarray(pixels, np.float32))
            residuals[name] = {weighting: dirty_image(operator, left, one).astype(float)
                               for weighting, one in weights.items()}
            power = data.weight * np.abs(left) ** 2
            chi_square[name] = np.bincount(block_of_sample, power, samples.size) / (2 * samples)
        return beams, residuals, chi_square

    def _operator(self, operators, plane, data):
        """Return the measurement operator of a grid, made once for each channel."""
        key = plane.shape, plane.cell_rad
        if key not in operators:
            grid = replace(self._grid, shape=plane.shape, cell_rad=plane.cell_rad)
            operators[key] = sky_operator(data.uvw, grid, eps=IMAGE_EPS, nthreads=self._nthreads)
        return operators[key]
