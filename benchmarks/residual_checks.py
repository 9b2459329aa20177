"""Whether what an image leaves of the data is noise: over baseline lengths, and in the residual image over scales.

    observed = Observed(Selection((vis,), datacolumn="data"), size, cell_arcsec)
    observed.chi_square(model)      # in eighths of the samples, from the shortest baselines to the longest
    observed.largest(residual, beam)  # of the residual image smoothed to 1, 2, 4 and 8 beams, in units of its noise

The noise is that measured from successive integrations, block by block.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from casa_sara.analysis.metrics import smooth
from casa_sara.casa.ms.read import read_visibilities
from casa_sara.casa.ms.weights import dirty_image
from casa_sara.data.blocks import snapshot_blocks
from casa_sara.data.noise import noise_from_differences
from casa_sara.data.visibilities import sort_into_blocks
from casa_sara.operators.measurement import MeasurementOperator

__all__ = ["BEAMS", "Observed"]

BINS = 8  # of baseline length, of as many samples each
BEAMS = (1, 2, 4, 8)  # to which the residual image is smoothed
REALISATIONS = 16  # of the noise


class Observed:
    """Visibilities, their noise, and what they hold beyond a model.

    Attributes
    ----------
    noise : float
        Measured, in units of the weights, median over the blocks.
    """

    def __init__(self, selection, size, cell_arcsec):
        data = read_visibilities(selection)
        self.data, offsets = sort_into_blocks(data, snapshot_blocks(data)[0])
        measured = noise_from_differences(self.data, offsets)
        middle = np.nanmedian(measured) if np.isfinite(measured).any() else 1.0
        self.noise = float(middle)
        noise = np.repeat(np.where(np.isfinite(measured), measured, middle), np.diff(offsets))
        self.sigma = noise / np.sqrt(self.data.weight.astype(float))  # of a real part, Jy
        self.cell_arcsec = cell_arcsec
        self._operator = self._sees((size, size), np.radians(cell_arcsec / 3600))

    def _sees(self, shape, cell_rad):
        return MeasurementOperator(self.data.uvw[:2], cell_rad, shape, dtype=np.float64, eps=1e-8)

    def left(self, model, cell_arcsec=None, centre=None):
        """Return data minus a model's visibilities, Jy; `cell_arcsec` and `centre` (pixel) where not the image's."""
        operator, cell_rad = self._operator, np.radians((cell_arcsec or self.cell_arcsec) / 3600)
        if cell_arcsec is not None or model.shape != operator.shape:
            operator = self._sees(model.shape, cell_rad)
        east, north = (0, 0) if centre is None else [at - n // 2 for at, n in zip(centre, model.shape)]
        turn = np.exp(2j * np.pi * cell_rad * (self.data.uvw[0] * east - self.data.uvw[1] * north))
        return self.data.vis - turn * operator.forward(np.ascontiguousarray(model, dtype=float))

    def chi_square(self, left):
        """Return Σ|r|²/(2Nσ²) of residual visibilities in eighths of the samples by baseline length: 1 for noise."""
        order = np.argsort(np.hypot(*self.data.uvw[:2]), kind="stable")
        power = (np.abs(left) / self.sigma)[order] ** 2 / 2
        return [float(part.mean()) for part in np.array_split(power, BINS)]

    def misfit(self, left):
        """Return Σ w|r|²/(2N), with the weights as they stand."""
        return float(np.sum(self.data.weight * np.abs(left) ** 2) / (2 * self.data.size))

    def natural(self, vis):
        """Return the image of visibilities in natural weighting, Jy/beam."""
        return dirty_image(self._operator, vis, self.data.imaging_weight.astype(float))

    def largest(self, residual, beam):
        """Return max |residual| at 1, 2, 4, 8 beams over what the noise has there, from realisations of the noise.

        Smoothing is with the Gaussian that makes the beam (arcsec, arcsec, degrees) so much wider.
        """
        rng = np.random.default_rng(1)
        draws = [rng.standard_normal((2, self.data.size)) for _ in range(REALISATIONS)]
        noises = [self.natural(self.sigma * (one[0] + 1j * one[1])) for one in draws]
        found = []
        for times in BEAMS:
            widths = np.array(beam[:2]) * np.sqrt(times**2 - 1) / self.cell_arcsec
            shown, *drawn = (smooth(image, widths, beam[2]) if times > 1 else image for image in [residual, *noises])
            found.append(float(np.abs(shown).max() / np.std(drawn)))
        return found
