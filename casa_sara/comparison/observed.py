"""The residuals of all models that are compared, from the visibilities, by one operator and with the same weights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from casa_sara.casa.images.image_files import read_spectra
from casa_sara.casa.images.image_plane import define_image_plane
from casa_sara.casa.images.restore import fit_beam
from casa_sara.casa.images.sky_image import SkyPlane, beam_numbers
from casa_sara.casa.images.spectral_index import with_spectrum
from casa_sara.casa.ms.read import read_visibilities
from casa_sara.casa.ms.weights import dirty_image, imaging_weights
from casa_sara.casa.runtime import log
from casa_sara.comparison.injection import spectral_index_of
from casa_sara.comparison.skies import is_mosaic
from casa_sara.data.blocks import snapshot_blocks
from casa_sara.imaging.mosaic import check_pointings
from casa_sara.imaging.plane_images import IMAGE_EPS
from casa_sara.operators.sky import sky_operator
from casa_sara.operators.subbands import Subbands
from casa_sara.operators.widefield import WTerm
from casa_sara.options import ImageGrid, Weighting
from casa_sara.reconstruction.compile_cache import kernels_loading

__all__ = ["Observed", "common_gridder"]

SMALLEST_W_PHASE = 0.01  # rad, in the corners of the image, that is worth the w-term


class Observed:
    """Visibilities, and the residuals of models, always with the same operator and the same weights.

    Attributes
    ----------
    plane : SkyPlane
        The common grid.
    beams : dict
        Weighting → major, minor in arcsec and position angle in degrees, fitted to the PSF.
    """

    def __init__(self, selection, plane, request, sets, notes):
        for one in sets:
            if one.record.get("outliers"):
                raise ValueError(f"models: '{one.name}' was imaged with an outlierfile, and residuals made from vis "
                                 "would hold the outliers: leave vis out, and the residual images are compared")
        longitude, latitude = (float(angle) for angle in plane.centre)
        grid = ImageGrid(plane.shape, plane.cell_rad, f"{plane.frame} {longitude!r}rad {latitude!r}rad")
        with kernels_loading(log.info):
            data = read_visibilities(selection, grid.phasecenter, frequencies=self._needs_frequencies(sets))
        data, grid = self._prepared(data, selection, grid, sets, notes)
        self._gridder = common_gridder(sets, data.max_w, plane, notes)
        image_plane = define_image_plane(data, selection, grid)
        notes.extend(image_plane.notes)
        self.plane, self._data, self._nthreads = SkyPlane(image_plane.csys, plane.shape), data, request.nthreads
        self._operators = {}
        operator = self._operator(self.plane, "models")
        self._weights = {"natural": imaging_weights(data, grid, Weighting("natural")),
                         "briggs": imaging_weights(data, grid, Weighting("briggs", request.robust))}
        ones = np.ones(data.size, np.complex64)
        self.beams = {weighting: beam_numbers(fit_beam(dirty_image(operator, ones, weights), image_plane))
                      for weighting, weights in self._weights.items()}
        self._block_of_sample, blocks = snapshot_blocks(data)
        self._samples = np.array([block.samples for block in blocks])

    def _needs_frequencies(self, sets):
        """Whether the samples keep their frequencies."""
        return any(spectral_index_of(one) or one.spectra for one in sets)

    def _prepared(self, data, selection, grid, sets, notes):
        """Return the samples that are used, and the grid for their weights."""
        notes.extend(data.notes + check_pointings(data, replace(grid, onepointing=True)))
        return data, grid

    @property
    def primary_beams(self) -> dict[str, np.ndarray]:
        """Weighting → primary beam (nx, ny) on the common grid, of a mosaic; else empty."""
        return {}

    def measured(self, sets, models):
        """Return the beams, and by product the residual images and χ² of the blocks, of models on the common grid."""
        residuals, chi_square = {}, {}
        for one in sets:
            left = self.minus(one, models[one.name])
            residuals[one.name], chi_square[one.name] = self.images(left), self.chi_square(left)
        return self.beams, residuals, chi_square

    def images(self, left):
        """Return the residual images by weighting, in Jy/beam, of residual visibilities."""
        operator = self._operator(self.plane, "models")
        return {weighting: dirty_image(operator, left, weights).astype(float)
                for weighting, weights in self._weights.items()}

    def chi_square(self, left):
        """Return Σ w|r|² / 2N of each block of residual visibilities: 1 for noise as given by the MS weights."""
        power = self._data.weight * np.abs(left) ** 2
        return np.bincount(self._block_of_sample, power, self._samples.size) / (2 * self._samples)

    def minus(self, one, model):
        """Return the data minus the visibilities of a product's model, which is given on the common grid.

        They are predicted from its own pixels where these have the common centre: regridding would blur it. A model of
        a known spectral index keeps its spectrum.
        """
        if one.spectra:
            return self._data.vis - self._of_spectra(one)
        image = one.model
        plane, pixels = (image.plane, image.pixels) if image.plane.is_aligned(self.plane) else (self.plane, model)
        operator = self._operator(plane, f"models: '{image.name}'", spectral_index_of(one), image.plane)
        return self._data.vis - operator.forward(np.asarray(pixels, np.float32))

    def _of_spectra(self, one):
        """Return the visibilities of a product whose spectra were solved for."""
        plane = one.model.plane
        if not plane.is_aligned(self.plane):
            raise ValueError(f"models: '{one.name}' was imaged with nterms > 1, and its visibilities are predicted "
                             "from its own pixels: the other models should have its centre")
        freqs_hz, spectra = read_spectra(one.spectra)
        subbands = Subbands(freqs_hz, np.full(freqs_hz.size, 1 / freqs_hz.size), freqs_hz[0], self._data.freq_range_hz)
        return self._seen(ImageGrid(plane.shape, plane.cell_rad, subbands=subbands), subbands.stacked(spectra))

    def _seen(self, grid, images):
        """Return the visibilities of images that are stacked."""
        operator = sky_operator(self._data.uvw, grid, self._data.freq_hz, eps=IMAGE_EPS, nthreads=self._nthreads)
        return operator.forward(images)

    def _operator(self, plane, what, spectralindex="", reference=None):
        key = plane.shape, plane.cell_rad, spectralindex
        if key not in self._operators:
            grid = ImageGrid(plane.shape, plane.cell_rad, gridder=self._gridder, spectralindex=spectralindex)
            if spectralindex:  # at the frequency of the model, not at that of the common grid
                grid = with_spectrum(grid, plane, reference)
            try:
                self._operators[key] = sky_operator(self._data.uvw, grid, self._data.freq_hz, eps=IMAGE_EPS,
                                                    nthreads=self._nthreads)
            except ValueError as error:
                raise ValueError(f"{what}: its visibilities cannot be computed for vis: {error}") from error
        return self._operators[key]


def common_gridder(sets, max_w, plane, notes):
    """Return the measurement operator for the residuals of all products, with a note about the reason.

    That is without the w-term where all were imaged without it, or where it is nothing; else with it.
    """
    if any(is_mosaic(one) for one in sets):
        return "standard"  # of the PSF; the operator of mosaics has the w-term in it
    phase = WTerm.of(max_w, plane.shape, plane.cell_rad, IMAGE_EPS).phase
    without = [one.name for one in sets if one.parameters.get("gridder", "") == "standard"
               or one.parameters.get("taskname") == "tsara" and "gridder" not in one.parameters]
    if len(without) == len(sets) or phase < SMALLEST_W_PHASE:
        return "standard"
    notes.append(f"the residuals of all are made with the w-term, which changes phases by up to {phase:.2g} rad in "
                 "this image"
                 + "".join(f"; '{name}' was imaged without it" for name in without))
    return "wproject"
