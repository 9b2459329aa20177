"""The residuals of mosaics that are compared: every sample through its own primary beam, images of flat noise."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np

from casa_sara.casa.images.spectral_index import with_spectrum
from casa_sara.casa.ms.weights import dirty_image
from casa_sara.comparison.injection import spectral_index_of
from casa_sara.comparison.observed import Observed
from casa_sara.imaging.mosaic import flat_noise, predicted, weight_image, with_beams
from casa_sara.imaging.plane_images import IMAGE_EPS
from casa_sara.operators.sky import sky_operator
from casa_sara.options import ImageGrid

__all__ = ["ObservedMosaic"]


class ObservedMosaic(Observed):
    """As `Observed`, of products that are the sky itself."""

    def _needs_frequencies(self, sets):
        return True

    def _prepared(self, data, selection, grid, sets, notes):
        data, grid = with_beams(data, selection, replace(grid, gridder="mosaic"))
        notes.extend(data.notes)
        self._selection, self._grid = selection, grid
        return data, grid

    @cached_property
    def _sky(self):
        """The operator of the common grid."""
        return sky_operator(self._data.uvw, self._grid, eps=IMAGE_EPS, nthreads=self._nthreads, beam=self._data.beam)

    @cached_property
    def _weight_images(self):
        return {weighting: weight_image(self._data, self._grid, weights) for weighting, weights in
                self._weights.items()}

    @property
    def primary_beams(self) -> dict[str, np.ndarray]:
        """Weighting → primary beam of the mosaic (nx, ny) on the common grid, 1 at its highest."""
        return {weighting: np.sqrt(weight / weight.max(), dtype=float) for weighting, weight in
                self._weight_images.items()}

    def images(self, left):
        """Return the residual images of flat noise by weighting, in Jy/beam, of residual visibilities."""
        return {weighting: flat_noise(dirty_image(self._sky, left, weights), self._weight_images[weighting])
                .astype(float) for weighting, weights in self._weights.items()}

    def minus(self, one, model):
        """Return the data minus the visibilities of a product's model, a sky on the common grid.

        As of `Observed`, they are predicted from its own pixels where these have the common centre.
        """
        if one.spectra:
            return self._data.vis - self._of_spectra(one)
        image = one.model
        plane, pixels = (image.plane, image.pixels) if image.plane.is_aligned(self.plane) else (self.plane, model)
        grid = ImageGrid(plane.shape, plane.cell_rad, gridder="mosaic", spectralindex=spectral_index_of(one))
        if grid.spectralindex:
            grid = with_spectrum(grid, plane, image.plane)
        return self._data.vis - self._seen(grid, np.asarray(pixels, np.float32))

    def _seen(self, grid, images):
        return predicted(images, self._data, self._selection, replace(grid, gridder="mosaic"),
                         self._grid.mosaic.profiles, eps=IMAGE_EPS, nthreads=self._nthreads)
