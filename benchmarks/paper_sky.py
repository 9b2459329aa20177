"""The true sky of the paper's experiments, and what it leaves of data that hold noise and calibration errors."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import binary_dilation, map_coordinates

from casa_sara.analysis.metrics import beam_pixels, smooth
from casa_sara.casa.ms.read import read_visibilities
from casa_sara.casa.ms.weights import dirty_image, imaging_weights
from casa_sara.demo.predict import predict
from casa_sara.demo.sky import ARCSEC, COMPANION_OFFSET, cyg_a_like
from casa_sara.operators.measurement import MeasurementOperator
from casa_sara.options import ImageGrid, Selection, Weighting

__all__ = ["APERTURE", "MASTER_CELL", "Truth", "aperture", "grid_of", "left_by_truth"]

FIELD = (30.72, 15.36)  # arcsec
MASTER_CELL = 0.02
APERTURE = 0.15  # arcsec, radius around the neighbour


class Truth:
    """The sky that is observed, and what it is on any grid."""

    def __init__(self):
        shape = tuple(round(size / MASTER_CELL) for size in FIELD)
        self.sky = cyg_a_like(shape, MASTER_CELL, oversampling=1)
        self.image = self.sky.truth()

    def on(self, shape, cell, fwhm_arcsec, angle=0.0):
        """Return the sky smoothed with a Gaussian, Jy per pixel of `cell`."""
        smoothed = smooth(self.image, [axis / MASTER_CELL for axis in fwhm_arcsec], angle)
        where = [(np.arange(n) - n // 2) * cell / MASTER_CELL + m // 2 for n, m in zip(shape, smoothed.shape)]
        return map_coordinates(smoothed, np.meshgrid(*where, indexing="ij"), order=3) * (cell / MASTER_CELL) ** 2

    def support(self, shape, cell):
        """Return where the sky is above a thousandth of its peak at 0.3 arcsec, or near it."""
        sky = self.on(shape, cell, (0.3, 0.3))
        return binary_dilation(sky > 1e-3 * sky.max(), iterations=round(0.3 / cell))


def aperture(image, cell, radius=APERTURE):
    """Return the flux within a radius of the neighbour's place."""
    nx, ny = image.shape
    east = -(np.arange(nx) - nx // 2)[:, None] * cell - COMPANION_OFFSET[0]
    north = (np.arange(ny) - ny // 2)[None, :] * cell - COMPANION_OFFSET[1]
    # pixels on the rim count by the share of them inside
    inside = np.clip((radius - np.hypot(east, north)) / cell + 0.5, 0, 1)
    return float(np.sum(image * inside))


def grid_of(cell):
    """Image size for the field at a cell size, even numbers."""
    return [2 * round(size / cell / 2) for size in FIELD]


def left_by_truth(truth, vis, cell, beams, weightings):
    """Restored image, residual and beam of the true sky by weighting: what noise and calibration errors leave.

    Its visibilities are predicted from its own grid, without error; the operator and the weights of the residual images
    are those of all models. `weightings` are parameters of the task, by name.
    """
    grid = ImageGrid(tuple(grid_of(cell)), (cell * ARCSEC, cell * ARCSEC))
    data = read_visibilities(Selection(tuple(vis), datacolumn="data"))
    left = data.vis - predict(truth.sky, data.uvw)
    operator, images = MeasurementOperator(data.uvw[:2], grid.cell_rad, grid.shape, dtype=np.float64), {}
    for w, beam in beams.items():
        residual = dirty_image(operator, left, imaging_weights(data, grid, Weighting(**weightings[w])))
        smoothed = beam_pixels(beam[:2], (cell, cell)) * truth.on(grid.shape, cell, beam[:2], beam[2])
        images[w] = smoothed + residual, residual, beam
    return images
